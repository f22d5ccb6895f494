"""List errors of metrics, their intervals, trajectory errors and calibration."""

from tests.mutants.mutant import Mutant

AGGREGATE, OF_AGGREGATE = "eval/metrics/aggregate.py", "tests/eval/test_aggregate.py"

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
        "cluster_of.setdefault(task, len(cluster_of)) for task in tasks",
        "cluster_of.setdefault((task, i), len(cluster_of)) for i, task in enumerate(tasks)",
        (f"{OF_AGGREGATE}::test_seeds_of_one_task_count_as_one_task",),
    ),
    Mutant(
        "bootstrap-not-paired",
        AGGREGATE,
        "[of_first[key][0] - of_second[key][0] for key in shared]",
        "[of_first[key][0] - other[0] for key, other in zip(shared, reversed(of_second.values()))]",
        (f"{OF_AGGREGATE}::test_the_paired_difference_is_exact_where_it_is_constant",),
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
)
