"""List errors of alignment, of what confirms a pose, of the trackers, and of PRISM's recursion."""

from tests.mutants.mutant import Mutant

RESIDUALS = "vssm_gym/inference/alignment/residuals.py"
ALGEBRA, DRIFT = "vssm_gym/inference/linear_gaussian.py", "vssm_gym/inference/prism/drift.py"
CAMERA_FILTER, PRISM = "vssm_gym/inference/tracking/camera_filter.py", "vssm_gym/inference/prism/filter.py"
OF_ALIGNMENT, OF_PRISM = "tests/inference/alignment/test_alignment.py", "tests/inference/test_prism.py"
OF_ALGEBRA, OF_DRIFT = "tests/inference/test_linear_gaussian.py", "tests/inference/test_drift.py"
OF_NOISE, OF_AGREEMENT = "tests/inference/test_process_noise.py", "tests/inference/alignment/test_agreement.py"
OF_SMOOTHING = "tests/inference/smoothing"
POSE_UPDATE = "vssm_gym/inference/tracking/pose_update.py"
ERRORS = "vssm_gym/inference/tracking/error_covariance.py"
OF_ERRORS = "tests/inference/test_error_covariance.py"
BY_HAND = (f"{OF_ALIGNMENT}::test_the_information_of_a_wall_by_hand",)

INFERENCE = (
    Mutant(
        "information-times-ten",
        RESIDUALS,
        "information=twists.T @ H @ twists",
        "information=10.0 * twists.T @ H @ twists",
        BY_HAND,
    ),
    Mutant(
        "residuals-without-the-quadratic-part-of-sigma",
        RESIDUALS,
        "sigma_geo = config.geo_sigma + config.geo_sigma_quadratic * depth * depth",
        "sigma_geo = config.geo_sigma + 0.0 * depth",
        BY_HAND,
    ),
    Mutant(
        "huber-weight-always-one",
        RESIDUALS,
        " * jnp.minimum(1.0, config.huber / jnp.maximum(jnp.abs(s), 1e-9))",
        "",
        (f"{OF_ALIGNMENT}::test_the_influence_of_a_residual_is_bounded",),
    ),
    Mutant(
        "alignment-jacobian-with-a-wrong-sign",
        RESIDUALS,
        "q[1] * z - q[2] * y",
        "q[2] * y - q[1] * z",
        (f"{OF_ALIGNMENT}::test_jacobians_are_those_of_the_residuals",),
    ),
    Mutant(
        "normal-equations-weighted-twice",
        RESIDUALS,
        "(rows * term.weight) @ rows.T",
        "(rows * term.weight**2) @ rows.T",
        (f"{OF_ALIGNMENT}::test_normal_equations_are_weighted_sums",),
    ),
    Mutant(
        "alignment-prior-without-its-gradient",
        "vssm_gym/inference/alignment/gauss_newton.py",
        "gradient = twists.T @ gradient + prior_precision @ xi",
        "gradient = twists.T @ gradient",
        (f"{OF_ALIGNMENT}::test_without_an_image_the_posterior_is_the_prior",),
    ),
    Mutant(
        "rotation-jacobian-with-a-wrong-sign",
        "vssm_gym/inference/alignment/rotation.py",
        "gx * (1.0 + x * x) + gy * x * y",
        "-gx * (1.0 + x * x) + gy * x * y",
        ("tests/inference/alignment/test_rotation.py::test_a_known_rotation_in_a_room_is_found",),
    ),
    Mutant(
        "rotation-not-used-as-a-start",
        "vssm_gym/inference/tracking/start_poses.py",
        "jnp.stack([inverse(reference.T_world_cam) @ T_world_turned, T_prior])",
        "jnp.stack([T_prior, T_prior])",
        (f"{OF_PRISM}::test_a_turn_that_nothing_predicts_is_tracked",),
    ),
    Mutant(
        "laplace-step-forgets-the-prior",
        POSE_UPDATE,
        "2.0 * information + precision",
        "2.0 * information + 1e-6 * precision",
        ("tests/inference/test_tracking.py::test_the_published_posterior_adds_information",),
    ),
    Mutant(
        "laplace-step-with-half-the-information",
        POSE_UPDATE,
        "2.0 * information + precision",
        "information + precision",
        ("tests/inference/test_tracking.py::test_the_published_posterior_adds_information",),
    ),
    Mutant(
        "gain-forgets-the-prior",
        POSE_UPDATE,
        "root = jnp.linalg.cholesky(correlation * one + L.T @ curvature @ L)",
        "root = jnp.linalg.cholesky(0.1 * correlation * one + L.T @ curvature @ L)",
        (f"{OF_ERRORS}::test_in_a_linear_gaussian_world_the_filter_is_the_kalman_filter",),
    ),
    Mutant(
        "errors-of-pixels-for-those-of-surfaces",
        "vssm_gym/inference/alignment/surface_error.py",
        "return self.surfaces.T @ self.surfaces + self.noise",
        "return self.noise",
        (f"{OF_PRISM}::test_a_step_is_the_linear_gaussian_algebra",),
    ),
    Mutant(
        "surfaces-without-what-the-pose-took-up",
        "vssm_gym/inference/alignment/surface_error.py",
        "left = jnp.maximum(1.0 - absorbed, surface.least_residual)",
        "left = jnp.ones_like(absorbed)",
        (
            "tests/inference/alignment/test_surface_error.py"
            "::test_the_influence_is_the_sum_over_the_pixels_of_each_patch",
        ),
    ),
    Mutant(
        "errors-of-surfaces-forgotten-between-images",
        ERRORS,
        "kept * F @ self.state_surfaces",
        "0.0 * F @ self.state_surfaces",
        (f"{OF_ERRORS}::test_covariances_are_those_of_simulated_errors",),
    ),
    Mutant(
        "the-map-takes-over-an-error-that-the-pose-keeps",
        ERRORS,
        "covariance = belief.covariance + apart @ self.frames @ apart.T + both + both.T",
        "covariance = belief.covariance",
        (f"{OF_ERRORS}::test_neither_writing_nor_rendering_changes_the_belief_in_the_world",),
    ),
    Mutant(
        "the-first-image-keeps-its-error-against-the-map",
        PRISM,
        "past = _renewed(_wrote(past, jnp.float32(FIRST_SHARE)))",
        "past = _renewed(_wrote(past, jnp.float32(0.0)))",
        (f"{OF_PRISM}::test_an_uncertain_start_stays_uncertain_in_the_world",),
    ),
    Mutant(
        "an-obstacle-stops-all-steps-since-the-last-image",
        CAMERA_FILTER,
        "_from_prediction(problem, T_ref_world @ manifold.pose(past.belief.mean) @ rig.T_body_cam)",
        "_from_prediction(problem, T_ref_world @ past.T_world_cam)",
        ("tests/inference/test_tracking.py::test_an_obstacle_is_remembered_until_a_step_is_seen_that_is_as_commanded",),
    ),
    Mutant(
        "unobserved-cells-colour-the-reference",
        "vssm_gym/inference/alignment/reference_view.py",
        "known = rendered.known & (m.observed_at(points) > 0.999)",
        "known = rendered.known",
        (f"{OF_ERRORS}::test_a_camera_that_slides_along_a_bare_wall_stays_inside_its_region",),
    ),
    Mutant(
        "obstacles-do-not-widen-the-prior",
        CAMERA_FILTER,
        "blocked = pose_covariance + obstacles.obstruction(back, turns)",
        "blocked = pose_covariance",
        ("tests/inference/test_tracking.py::test_a_blocked_robot_is_uncertain_by_its_commanded_step",),
    ),
    Mutant(
        "an-image-that-fits-nowhere-is-no-obstacle",
        CAMERA_FILTER,
        "past.obstructed | (jnp.any(image.hit) & ~accepted)",
        "past.obstructed",
        ("tests/inference/test_tracking.py::test_an_image_that_fits_nowhere_may_show_what_stopped_the_robot",),
    ),
    Mutant(
        "a-view-of-the-unknown-costs-as-much-as-a-misfit",
        "vssm_gym/inference/alignment/residuals.py",
        "jnp.minimum(jnp.abs(geo.residual), config.cost_limit), config.unseen_cost)",
        "jnp.minimum(jnp.abs(geo.residual), config.cost_limit), config.cost_limit)",
        (
            "tests/inference/alignment/test_alignment.py"
            "::test_a_view_without_overlap_costs_more_than_a_fit_and_less_than_a_misfit",
        ),
    ),
    Mutant(
        "an-obstacle-is-forgotten-unseen",
        "vssm_gym/inference/tracking/obstacles.py",
        "return translation @ covariance @ translation < (SHOWN * translation @ translation) ** 2",
        "return translation @ translation > 0.0",
        (
            "tests/inference/test_obstacles.py::test_only_an_estimate_of_the_commanded_translation_shows_that_a_body_is_free",
        ),
    ),
    Mutant(
        "a-surface-is-displaced-as-a-whole-alone",
        "vssm_gym/inference/alignment/surface_error.py",
        'noise += jnp.einsum("bia,bja->ij", shift, shift) + blur.T @ blur',
        "noise += 0.0 * noise",
        (
            "tests/inference/alignment/test_surface_error.py"
            "::test_the_influence_is_the_sum_over_the_pixels_of_each_patch",
        ),
    ),
    Mutant(
        "velocity-does-not-follow-the-pose",
        POSE_UPDATE,
        "moved = jnp.concatenate([moved, rest.A @ moved])",
        "moved = jnp.concatenate([moved, 0.0 * rest.A @ moved])",
        (f"{OF_PRISM}::test_a_step_is_the_linear_gaussian_algebra",),
    ),
    Mutant(
        "joint-mean-without-the-conditional",
        ALGEBRA,
        "jnp.concatenate([p_z.mean, A @ p_z.mean + p_x_given_z.a])",
        "jnp.concatenate([p_z.mean, p_x_given_z.a])",
        (f"{OF_ALGEBRA}::test_the_joint_is_the_dense_product",),
    ),
    Mutant(
        "posterior-covariance-without-the-gains-noise",
        ALGEBRA,
        "B @ p_z.covariance @ B.T + K @ S @ K.T",
        "B @ p_z.covariance @ B.T",
        (f"{OF_ALGEBRA}::test_the_inverse_conditional_is_the_dense_posterior",),
    ),
    Mutant(
        "drift-left-out-of-the-belief",
        PRISM,
        "with_sensor_errors(past.considered.in_world(past.belief), start",
        "with_sensor_errors(past.belief, start",
        (f"{OF_DRIFT}::test_a_belief_in_the_world_includes_the_drift",),
    ),
    Mutant(
        "a-turn-seen-the-wrong-way",
        "vssm_gym/inference/tracking/visual_turn.py",
        "error = angle - moved[k]",
        "error = moved[k] - angle",
        ("tests/inference/test_visual_turn.py::test_a_correction_is_the_products_of_two_gaussians",),
    ),
    Mutant(
        "a-turn-seen-leaves-its-noise",
        "vssm_gym/inference/tracking/visual_turn.py",
        ".add(-taken)",
        ".add(0.0 * taken)",
        ("tests/inference/test_visual_turn.py::test_the_turn_is_seen_to_half_a_degree_whatever_the_exposure",),
    ),
    Mutant(
        "a-turn-seen-takes-more-than-its-own-variance",
        "vssm_gym/inference/tracking/visual_turn.py",
        "jnp.minimum(share * variance, INDEPENDENT * _alone(considered.joint(belief.covariance), k))",
        "share * variance",
        ("tests/inference/test_visual_turn.py::test_a_corrected_covariance_is_one_however_errors_are_correlated",),
    ),
    Mutant(
        "views-of-another-place-are-kept",
        "vssm_gym/inference/tracking/standing_views.py",
        "count = jnp.where(jnp.any(kept & elsewhere), 0, views.count)",
        "count = views.count",
        ("tests/inference/test_visual_turn.py::test_views_are_kept_apart_and_forgotten_where_the_robot_has_driven",),
    ),
    Mutant(
        "drift-left-out-of-a-prediction",
        PRISM,
        "return lost, FilterInfo(status, in_world, quality)",
        "return lost, FilterInfo(status, past.belief, quality)",
        (f"{OF_DRIFT}::test_a_belief_in_the_world_includes_the_drift",),
    ),
    Mutant(
        "scale-about-the-origin-of-the-world",
        PRISM,
        "(pose[:3, 3] - start)",
        "pose[:3, 3]",
        (f"{OF_DRIFT}::test_the_scale_of_the_depth_moves_a_pose_along_its_displacement",),
    ),
    Mutant(
        "scale-along-the-axes-of-the-world",
        PRISM,
        "pose[:3, :3].T @ (pose[:3, 3] - start)",
        "(pose[:3, 3] - start)",
        (f"{OF_DRIFT}::test_the_scale_of_the_depth_moves_a_pose_along_its_displacement",),
    ),
    Mutant(
        "drift-carried-to-the-wrong-frame",
        ERRORS,
        "se3_adjoint(inverse(belief.manifold.pose(belief.mean)))",
        "se3_adjoint(belief.manifold.pose(belief.mean))",
        (f"{OF_DRIFT}::test_in_world_is_the_covariance_of_a_pose_in_an_uncertain_frame",),
    ),
    Mutant(
        "drift-by-the-precision-for-its-share",
        DRIFT,
        "read * (1.0 - before / after)",
        "read * (after - before)",
        (f"{OF_DRIFT}::test_an_image_writes_its_share_of_the_map_in_view",),
    ),
    Mutant(
        "pose-samples-too-narrow",
        PRISM,
        "half = (samples / (samples - 1)) ** 0.5 * jax.random.normal",
        "half = jax.random.normal",
        (f"{OF_PRISM}::test_samples_of_the_pose_have_its_mean_and_covariance",),
    ),
    Mutant(
        "process-noise-without-the-square-of-caution",
        "vssm_gym/inference/tracking/process_noise.py",
        "config.caution**2 * jnp.stack",
        "config.caution * jnp.stack",
        (f"{OF_NOISE}::test_the_scale_is_the_hands_own_times_a_margin",),
    ),
    Mutant(
        "process-noise-learns-from-unseen-directions",
        "vssm_gym/inference/tracking/process_noise.py",
        "removed = jnp.clip(1.0 - left, 0.0, 1.0)",
        "removed = jnp.ones_like(left)",
        (f"{OF_NOISE}::test_an_image_without_information_changes_nothing",),
    ),
    Mutant(
        "frame-tracker-forgets-earlier-uncertainty",
        "vssm_gym/inference/tracking/map_tracker.py",
        "covariance=carried + kept.covariance",
        "covariance=kept.covariance",
        ("tests/inference/test_tracking.py::test_frame_to_frame_tracking_drifts_within_its_covariance",),
    ),
    Mutant(
        "correlation-without-centring",
        "vssm_gym/inference/alignment/agreement.py",
        "a, b = (x - jnp.sum(weight * x) for x in (luminance, reference))",
        "a, b = luminance, reference",
        (f"{OF_AGREEMENT}::test_a_displaced_pose_a_mirrored_image_and_a_grey_one_do_not_agree",),
    ),
    Mutant(
        "pose-fixed-by-the-trace-of-information",
        "vssm_gym/inference/alignment/agreement.py",
        "jnp.linalg.eigvalsh(2.0 * twists.T @ H @ twists)[0]",
        "jnp.diag(2.0 * twists.T @ H @ twists).max()",
        (f"{OF_AGREEMENT}::test_a_room_fixes_the_pose_and_a_bare_wall_does_not",),
    ),
    Mutant(
        "aliases-sought-too-far-away",
        "vssm_gym/inference/alignment/aliasing.py",
        "(np.abs(SHIFTS[1:-1, None]) >= APART)",
        "(np.abs(SHIFTS[1:-1, None]) >= FARTHEST_SHIFT)",
        ("tests/inference/alignment/test_aliasing.py::test_a_wall_of_equal_stripes_fits_at_several_places",),
    ),
    Mutant(
        "confirmation-asks-grey-images-to-correlate",
        "vssm_gym/inference/tracking/confirmation.py",
        " | (found.contrast < config.min_contrast)",
        "",
        (f"{OF_AGREEMENT}::test_an_image_without_contrast_confirms_nothing_and_refutes_nothing",),
    ),
    Mutant(
        "recovery-without-the-contrast-test",
        "vssm_gym/inference/tracking/recovery.py",
        "jnp.clip(config.max_unexplained * contrast, 1.0, config.max_photometric)",
        "config.max_photometric",
        (
            "tests/inference/test_recovery.py::test_what_is_unexplained_of_an_image_counts_in_proportion_to_its_contrast",
        ),
    ),
    Mutant(
        "gyroscope-bias-ignored",
        "vssm_gym/inference/prism/imu_control.py",
        "(self._rates[first:last] - self.gyro_bias)",
        "self._rates[first:last]",
        ("tests/inference/test_imu_control.py::test_dead_reckoning_with_the_controls_is_the_flight",),
    ),
    Mutant(
        "smoothing-with-each-image's-own-gradient",
        "vssm_gym/inference/smoothing/agreement.py",
        'g = jnp.einsum("vi,tij->tvj", gradient, T_world_cam[:, :3, :3])',
        'g = jnp.einsum("vi,tij->tvj", gradient, T_world_cam[:, :3, :3]) * (1.0 + 0.1 * point[..., :1])',
        (f"{OF_SMOOTHING}/test_agreement.py::test_a_motion_of_all_cameras_together_changes_nothing",),
    ),
    Mutant(
        "smoothing-with-the-map-held-fixed",
        "vssm_gym/inference/smoothing/agreement.py",
        "hessian = (-coupled).at[index, :, index].add(own)",
        "hessian = jnp.zeros_like(coupled).at[index, :, index].add(own)",
        (f"{OF_SMOOTHING}/test_agreement.py::test_the_elements_are_integrated_out_as_in_a_dense_system",),
    ),
    Mutant(
        "smoothed-covariance-counts-every-reading",
        "vssm_gym/inference/smoothing/gauss_newton.py",
        "poses = spread.T @ spread + inverse @ chain.hessian @ inverse",
        "poses = inverse",
        (f"{OF_SMOOTHING}/test_gauss_newton.py::test_errors_of_a_surface_widen_the_covariance",),
    ),
)
