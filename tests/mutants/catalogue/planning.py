"""List errors of expected information, exploration, value iteration and model-predictive control."""

from tests.mutants.mutant import Mutant

INFORMATION, MPC = "vssm_gym/planning/exploration/information", "vssm_gym/planning/mpc/objective.py"
PLANE, OF_PLANE = "vssm_gym/planning/exploration/plane", "tests/planning/test_plane_exploration.py"
OF_INFORMATION = "tests/planning/test_information.py"
OF_VALUE = ("tests/planning/car/test_value_iteration.py::test_agrees_with_an_exact_dynamic_program",)
OF_MPC = ("tests/planning/car/test_mpc_objective.py::test_values_are_those_of_the_definition",)

PLANNING = (
    Mutant(
        "a-motion-need-not-be-seen",
        "vssm_gym/planning/scans/search.py",
        "length + edges.need - edges.slack",
        "0.0",
        (
            "tests/planning/scans/test_hybrid_astar.py"
            "::test_a_place_behind_a_wall_is_not_entered_whatever_is_predicted_there",
        ),
    ),
    Mutant(
        "a-drive-needs-no-clearance",
        "vssm_gym/planning/scans/hybrid_astar.py",
        "need = radius + margin",
        "need = 0.5 * radius + margin",
        ("tests/planning/scans/test_hybrid_astar.py::test_drives_keep_the_exact_clearance",),
    ),
    Mutant(
        "an-edge-costs-as-its-end",
        "vssm_gym/planning/grid_search/astar.py",
        "length *= 0.5 * (weight[i, j] + weight[i + di, j + dj])",
        "length *= weight[i + di, j + dj]",
        ("tests/planning/test_path_cost.py::test_astar_costs_as_much_as_dijkstra",),
    ),
    Mutant(
        "a-path-is-entered-where-it-is-seen-last",
        "vssm_gym/planning/grid_search/path_shortening.py",
        "if total < least - 1e-9 and segment_free(",
        "if best == 0 and segment_free(",
        ("tests/planning/test_path_cost.py::test_shortening_never_costs_more_and_stays_free",),
    ),
    Mutant(
        "unknown-space-is-free-of-charge",
        "vssm_gym/planning/traversability.py",
        "np.where(inside, config.unknown, config.unknown * config.outside)",
        "0.0",
        ("tests/planning/test_traversability.py::test_a_path_through_the_unknown_pays_for_it",),
    ),
    Mutant(
        "information-counted-twice",
        f"{INFORMATION}/information_sum.py",
        "return 0.5 * (nats + np.log(product))",
        "return nats + np.log(product)",
        (f"{OF_INFORMATION}::test_a_map_of_3x3x1_cells_by_hand",),
    ),
    Mutant(
        "every-view-of-a-cell-is-its-first",
        f"{INFORMATION}/information_sum.py",
        "precision[b, s, r] + counts[b, s, r] * weight",
        "precision[b, s, r]",
        (f"{OF_INFORMATION}::test_a_map_of_3x3x1_cells_by_hand",),
    ),
    Mutant(
        "imagined-views-end-at-the-surface",
        f"{INFORMATION}/observed.py",
        "d - z > -truncation",
        "d - z > 0.0",
        (f"{OF_INFORMATION}::test_a_view_holds_the_cells_whose_precision_the_update_raises",),
    ),
    Mutant(
        "explorer-counts-known-cells",
        "agents/exploration/mi_explorer.py",
        "known=OBSERVED_PRECISION, ",
        "",
        ("tests/planning/test_explorer_choices.py::test_an_explorer_stops_where_all_cells_were_observed",),
    ),
    Mutant(
        "pose-information-of-variance-for-std",
        f"{INFORMATION}/pose.py",
        "np.eye(3) + std[:, None] * F * std",
        "np.eye(3) + std[:, None] ** 2 * F * std**2",
        ("tests/planning/test_pose_information.py",),
    ),
    Mutant(
        "hazard-by-depth-for-length",
        f"{INFORMATION}/ray_termination.py",
        "left -= voxel * met",
        "left -= step * met",
        ("tests/planning/test_ray_termination.py::test_in_unknown_space_rays_have_the_configured_length",),
    ),
    Mutant(
        "bilinear-weights-exchanged",
        "vssm_gym/planning/value_iteration/sweeps.py",
        "(1 - u) * v, u * (1 - v), u * v",
        "u * (1 - v), (1 - u) * v, u * v",
        OF_VALUE,
    ),
    Mutant(
        "values-not-discounted",
        "vssm_gym/planning/value_iteration/sweeps.py",
        "top if at_goal[k] else gamma * best[k]",
        "top if at_goal[k] else best[k]",
        OF_VALUE,
    ),
    Mutant(
        "sweeps-skip-what-a-moved-band-reaches",
        "vssm_gym/planning/value_iteration/sweeps.py",
        "(x + BAND_ROWS + low) // BAND_ROWS + 1",
        "(x + BAND_ROWS + low) // BAND_ROWS",
        ("tests/planning/car/test_sweeps.py",),
    ),
    Mutant(
        "backward-arcs-turn-as-forward-ones",
        "vssm_gym/planning/value_iteration/motions.py",
        "[*self.turns, *(-b for b in self.turns)]",
        "[*self.turns, *self.turns]",
        ("tests/model/test_bicycle_twins.py",),
    ),
    Mutant(
        "cost-to-go-at-the-end-not-discounted",
        MPC,
        "last_weight * value[..., -1]",
        "value[..., -1]",
        OF_MPC,
    ),
    Mutant(
        "first-change-of-control-is-free",
        MPC,
        "first = jnp.broadcast_to(last / limits,",
        "first = jnp.broadcast_to(scaled[..., 0, :],",
        OF_MPC,
    ),
    Mutant(
        "footprint-discs-turned-the-wrong-way",
        MPC,
        "[states[..., :1] + c * x - s * y, states[..., 1:2] + s * x + c * y]",
        "[states[..., :1] + c * x + s * y, states[..., 1:2] - s * x + c * y]",
        OF_MPC,
    ),
    Mutant(
        "headings-of-a-turning-robot-kept",
        f"{PLANE}/information.py",
        "return poses.at[..., 2].set(off)",
        "return poses",
        (f"{OF_PLANE}::test_what_is_seen_twice_counts_once",),
    ),
    Mutant(
        "a-more-dangerous-sequence-kept",
        f"{PLANE}/controls.py",
        "better = found <= least",
        "better = found >= least",
        (f"{OF_PLANE}::test_refined_sequences_are_safer_and_never_worse",),
    ),
    Mutant(
        "unknown-cells-solid-by-the-prior",
        "vssm_gym/model/scan_emission.py",
        "> jnp.exp(-1.0 / self.free_path)",
        "> 0.5",
        ("tests/inference/planar/test_planar_prism_of_scans.py::test_unknown_space_of_a_drawn_map_lets_beams_pass",),
    ),
    Mutant(
        "random-search-by-the-worst-directions",
        "vssm_gym/training/random_search/search.py",
        "np.argsort(-pairs.max(axis=1)",
        "np.argsort(pairs.max(axis=1)",
        ("tests/training/test_random_search.py::test_only_the_best_directions_move_the_parameters",),
    ),
)
