"""List errors of metrics, their intervals, trajectory errors and calibration."""

from tests.mutants.mutant import Mutant

POSES, OF_POSES = "eval/metrics/pose_calibration.py", "tests/eval/test_pose_calibration.py"
OF_TRUST = "tests/agents/test_trust.py"
AGGREGATE, OF_AGGREGATE = "eval/metrics/aggregate.py", "tests/eval/test_aggregate.py"
OF_RESAMPLING = "tests/eval/test_resampling.py"
OF_MATCHING = "tests/eval/studies/scan_graph/test_matching.py"

EVALUATION = (
    Mutant(
        "spl-with-the-wrong-denominator",
        "eval/metrics/navigation.py",
        "return shortest / np.maximum(taken, shortest)",
        "return shortest / np.maximum(taken, 1e-9)",
        ("tests/eval/test_metrics.py::test_bounds",),
    ),
    Mutant(
        "soft-spl-without-progress",
        "eval/metrics/navigation.py",
        "np.maximum(0.0, 1.0 - remaining / np.asarray(geodesic, dtype=np.float64)) * efficiency",
        "np.where(remaining < np.asarray(geodesic, dtype=np.float64), efficiency, 0.0)",
        ("tests/eval/test_metrics.py::test_by_hand",),
    ),
    Mutant(
        "bootstrap-over-episodes-for-tasks",
        AGGREGATE,
        "resampling.scores(np.asarray(values, np.float64), tasks,",
        "resampling.scores(np.asarray(values, np.float64), range(len(values)),",
        (f"{OF_AGGREGATE}::test_seeds_of_one_task_count_as_one_task",),
    ),
    Mutant(
        "bootstrap-not-paired",
        AGGREGATE,
        "zip(first, second, strict=True)",
        "zip(first, second[::-1], strict=True)",
        (f"{OF_AGGREGATE}::test_the_paired_difference_is_exact_where_it_is_constant",),
    ),
    Mutant(
        "bootstrap-of-one-training",
        AGGREGATE,
        "[0] * len(values) if runs is None else runs",
        "[0] * len(values)",
        (f"{OF_RESAMPLING}::test_where_runs_alone_differ_the_interval_is_that_of_student",),
    ),
    Mutant(
        "interquartile-mean-of-too-many",
        "eval/metrics/resampling.py",
        "np.floor(TRIMMED * upper[:, -1:])",
        "np.floor(0.5 * TRIMMED * upper[:, -1:])",
        (f"{OF_RESAMPLING}::test_the_interquartile_mean_is_that_of_scipy",),
    ),
    Mutant(
        "proportions-with-a-uniform-prior",
        "eval/metrics/proportions.py",
        "stats.beta.ppf(TAIL, k, n - k + 1)",
        "stats.beta.ppf(TAIL, k + 1, n - k + 1)",
        ("tests/eval/test_proportions.py::test_clopper_and_pearson_as_in_scipy",),
    ),
    Mutant(
        "nees-without-correlations",
        "vssm_gym/slam/calibration.py",
        "np.linalg.solve(L, (e / std)[..., None])[..., 0]",
        "e / std",
        ("tests/slam/test_calibration.py::test_nees_is_the_squared_mahalanobis_distance",),
    ),
    Mutant(
        "pose-residual-without-the-coupling-of-rotation",
        "vssm_gym/slam/calibration.py",
        "T[:, :3, 3] - 0.5 * w_t + c * np.cross(w, w_t)",
        "T[:, :3, 3]",
        ("tests/slam/test_calibration.py::test_the_residual_is_the_tangent_step_to_the_truth",),
    ),
    Mutant(
        "nees-of-singular-covariances-undefined",
        POSES,
        "(axes * np.maximum(values, least)[:, None, :])",
        "(axes * values[:, None, :])",
        (f"{OF_POSES}::test_a_direction_without_variance_counts_like_the_others",),
    ),
    Mutant(
        "nees-not-divided-by-the-dimension",
        POSES,
        "float(values.mean()) / dimension",
        "float(values.mean())",
        (f"{OF_POSES}::test_the_nees_of_errors_drawn_from_the_stated_covariance_is_one",),
    ),
    Mutant(
        "region-of-another-dimension",
        POSES,
        "values <= chi2.ppf(REGION, dimension)",
        "values <= chi2.ppf(REGION, 2)",
        (f"{OF_POSES}::test_the_region_holds_its_probability",),
    ),
    Mutant(
        "known-start-counts-as-an-estimate",
        "eval/protocols/episode.py",
        "zip(decisions[1:], poses[1:], strict=False)",
        "zip(decisions, poses, strict=False)",
        ("tests/eval/test_episode.py::test_the_calibration_of_estimates_by_hand",),
    ),
    Mutant(
        "estimates-compared-with-the-pose-after-the-step",
        "eval/protocols/episode.py",
        "zip(decisions[1:], poses[1:], strict=False)",
        "zip(decisions[1:], poses[2:], strict=False)",
        ("tests/eval/test_episode.py::test_the_calibration_of_estimates_by_hand",),
    ),
    Mutant(
        "stated-covariance-in-world-axes",
        "agents/shared/localization.py",
        "jnp.diagonal(world_covariance(belief)), stated)",
        "jnp.diagonal(world_covariance(belief)), world_covariance(belief))",
        ("tests/agents/test_agents.py::test_dead_reckoning_states_its_error_correctly",),
    ),
    Mutant(
        "drift-left-out-of-the-stated-covariance",
        "agents/shared/trust.py",
        "self._in_world = info.belief",
        "self._in_world = self._belief()",
        (f"{OF_TRUST}::test_the_drift_of_the_map_is_in_the_covariance_that_is_stated_and_not_in_what_is_planned_by",),
    ),
    Mutant(
        "fits-at-several-places-confirm-the-last-one",
        "agents/shared/trust.py",
        "status, followed, self._fits = Status.RECOVERED, False, 0",
        "status, followed = Status.RECOVERED, False",
        (f"{OF_TRUST}::test_the_estimate_leaves_for_another_place_when_that_is_confirmed",),
    ),
    Mutant(
        "alignment-of-trajectories-may-reflect",
        "vssm_gym/slam/trajectory_error.py",
        "R = (U * flip) @ Vt",
        "R = U @ Vt",
        ("tests/slam/test_trajectory_metrics.py::test_alignment_is_optimal",),
    ),
    Mutant(
        "relative-error-in-the-world-frame",
        "vssm_gym/slam/trajectory_error.py",
        "inverse(inverse(Q[:-delta]) @ Q[delta:])",
        "inverse(Q[delta:] @ inverse(Q[:-delta]))",
        ("tests/slam/test_trajectory_metrics.py::test_alignment_recovers_the_motion",),
    ),
    Mutant(
        "scan-matching-turns-the-wrong-way",
        "eval/studies/scan_graph/matching.py",
        "across[:, 1] * p[:, 0] - across[:, 0] * p[:, 1]",
        "across[:, 0] * p[:, 1] - across[:, 1] * p[:, 0]",
        (f"{OF_MATCHING}::test_a_known_motion_is_recovered",),
    ),
    Mutant(
        "surfaces-seen-from-behind",
        "eval/studies/scan_graph/clouds.py",
        "weight *= (points.views[at][i] * points.views[j]).sum(axis=1) > 0.0",
        "weight *= 1.0",
        (f"{OF_MATCHING}::test_a_thin_wall_has_two_surfaces",),
    ),
    Mutant(
        "odometry-error-carried-backwards",
        "eval/studies/scan_graph/run.py",
        "[[c, s, -c * motion[1] + s * motion[0]], [-s, c, s * motion[1] + c * motion[0]]",
        "[[c, -s, -c * motion[1] + s * motion[0]], [s, c, s * motion[1] + c * motion[0]]",
        ("tests/eval/studies/scan_graph/test_run.py::test_an_error_is_carried_over_a_motion",),
    ),
    Mutant(
        "blocks-of-a-search-begin-in-their-middle",
        "eval/studies/scan_graph/correlative.py",
        "origin=-(SEARCH_BLOCK // 2)",
        "origin=0",
        (f"{OF_MATCHING}::test_the_coarse_field_bounds_the_fine_one",),
    ),
)
