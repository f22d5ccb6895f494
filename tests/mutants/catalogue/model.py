"""List errors of rigid motions, transitions, beliefs and the robots that transitions describe."""

from tests.mutants.mutant import Mutant

TRANSITION = "vssm_gym/model/transition"
GEOMETRY, RIGID, IMU = "tests/geometry/test_geometry.py", "tests/model/test_rigid.py", "tests/model/test_imu.py"
BICYCLE, WHEELS, PLANAR = (
    "tests/model/test_bicycle.py",
    "tests/model/test_differential.py",
    "tests/model/test_transition.py",
)
ROBOTS = "tests/envs/robots/test_holonomic.py"
RESPONSE = "tests/envs/robots/test_drive_response.py"
IMAGINED = "tests/envs/world_model/test_learned_motion.py"
LEARNED, OBJECTIVE = "tests/model/test_learned_transition.py", "tests/training/dynamics/test_objective.py"

MODEL = (
    Mutant(
        "learned-correction-in-world-axes",
        f"{TRANSITION}/learned.py",
        "axes.to_errors(after, h *",
        "(lambda _, e: e)(after, h *",
        (f"{LEARNED}::test_neither_place_nor_yaw_matters_in_space",),
    ),
    Mutant(
        "lever-arm-without-centripetal-force",
        f"{TRANSITION}/calibrated.py",
        "jnp.cross(w, jnp.cross(w, lever)) + ",
        "",
        (f"{LEARNED}::test_the_constants_of_an_imu_agree_with_a_simulation",),
    ),
    Mutant(
        "inverse-emission-fused-without-the-transition",
        "vssm_gym/training/dynamics/objective.py",
        "share = prior_std**2 / (prior_std**2 + std**2)",
        "share = jnp.ones_like(std)",
        (f"{OBJECTIVE}::test_fusion_is_the_product_of_gaussians",),
    ),
    Mutant(
        "adjoint-transposed",
        "vssm_gym/geometry/transforms.py",
        "from_matrix(T).adjoint()",
        "from_matrix(T).adjoint().T",
        (f"{GEOMETRY}::test_adjoint_carries_tangents_between_frames",),
    ),
    Mutant(
        "se3-exponential-without-second-order",
        "vssm_gym/geometry/transforms.py",
        "t = v + a * w_v + b * jnp.cross(w, w_v)",
        "t = v + a * w_v",
        (f"{GEOMETRY}::test_exponential_is_the_matrix_exponential",),
    ),
    Mutant(
        "rigid-body-moves-without-dt",
        f"{TRANSITION}/rigid.py",
        "T_world_body[..., :3, 3] + velocity[..., :3] * dt",
        "T_world_body[..., :3, 3] + velocity[..., :3]",
        (f"{RIGID}::test_a_step_is_one_of_eulers_method",),
    ),
    Mutant(
        "rigid-jacobian-left-for-right",
        f"{TRANSITION}/rigid.py",
        "right_jacobian(turn) * dt",
        "right_jacobian(-turn) * dt",
        (f"{RIGID}::test_prediction_is_linearised_as_autodiff_does",),
    ),
    Mutant(
        "rigid-noise-grows-with-the-square-of-time",
        f"{TRANSITION}/rigid.py",
        "velocity**2 * (dt / QUOTED_STEP)",
        "velocity**2 * (dt / QUOTED_STEP) ** 2",
        (f"{RIGID}::test_variances_grow_with_time",),
    ),
    Mutant(
        "imu-gravity-has-the-wrong-sign",
        f"{TRANSITION}/imu.py",
        "+ jnp.asarray(GRAVITY)) * dt",
        "- jnp.asarray(GRAVITY)) * dt",
        (f"{IMU}::test_a_resting_imu_stays",),
    ),
    Mutant(
        "imu-jacobian-tilts-the-wrong-way",
        f"{TRANSITION}/imu.py",
        "tilt = -R @ _cross_matrix",
        "tilt = R @ _cross_matrix",
        (f"{IMU}::test_prediction_is_linearised_as_autodiff_does",),
    ),
    Mutant(
        "bicycle-turns-by-the-sine-of-its-steering",
        f"{TRANSITION}/bicycle.py",
        "turn = s * jnp.tan(control[..., 1]) / wheelbase",
        "turn = s * jnp.sin(control[..., 1]) / wheelbase",
        (f"{BICYCLE}::test_an_arc_solves_the_differential_equation",),
    ),
    Mutant(
        "bicycle-noise-in-the-frame-before-the-step",
        f"{TRANSITION}/bicycle.py",
        "G = back @ jax.jacfwd(arc)",
        "G = jax.jacfwd(arc)",
        (f"{BICYCLE}::test_prediction_is_linearised_as_autodiff_does",),
    ),
    Mutant(
        "wheels-half-a-track-apart",
        f"{TRANSITION}/differential.py",
        "(right - left) / self.track",
        "(right - left) / (2.0 * self.track)",
        (f"{WHEELS}::test_the_robot_equals_the_models_law",),
    ),
    Mutant(
        "planar-noise-in-the-frame-before-the-turn",
        f"{TRANSITION}/planar.py",
        "c, s = jnp.cos(offset - turn), jnp.sin(offset - turn)",
        "c, s = jnp.cos(offset), jnp.sin(offset)",
        (f"{PLANAR}::test_prediction_from_a_known_pose_agrees_with_simulation",),
    ),
    Mutant(
        "planar-jacobian-with-a-wrong-sign",
        f"{TRANSITION}/planar.py",
        "c * -dy + s * dx",
        "c * dy + s * dx",
        (f"{PLANAR}::test_the_default_jacobian_is_the_transitions_own",),
    ),
    Mutant(
        "noise-scale-applied-on-one-side",
        f"{TRANSITION}/base.py",
        "Q = scale[:, None] * self.noise_covariance(belief.mean, control, dt) * scale",
        "Q = scale[:, None] * self.noise_covariance(belief.mean, control, dt)",
        (f"{PLANAR}::test_prediction_is_of_first_order",),
    ),
    Mutant(
        "density-without-the-volume-of-the-group",
        f"{TRANSITION}/belief.py",
        "return normal_log_prob(xi, self.covariance) - self.manifold.log_volume(xi)",
        "return normal_log_prob(xi, self.covariance)",
        (f"{PLANAR}::test_the_entropy_of_a_belief_is_its_mean_surprise",),
    ),
    Mutant(
        "robot-noise-of-variance-for-std",
        "vssm_gym/envs/robots/holonomic.py",
        "rng.standard_normal(2) * (noise.turn, noise.step)",
        "rng.standard_normal(2) * (noise.turn**2, noise.step**2)",
        (f"{ROBOTS}::test_errors_follow_the_truncated_gaussian",),
    ),
    Mutant(
        "robot-noise-turns-the-body-and-not-its-path",
        "vssm_gym/envs/robots/holonomic.py",
        "phi = heading + offset + e_a",
        "phi = heading + offset",
        (f"{ROBOTS}::test_the_same_error_turns_the_body_and_its_path",),
    ),
    Mutant(
        "worn-drive-that-never-rests",
        "vssm_gym/envs/robots/drive_response.py",
        "return np.where(held, 0.0, reached)",
        "return reached",
        (f"{RESPONSE}::test_a_robot_that_is_told_to_rest_comes_to_rest",),
    ),
    Mutant(
        "worn-drive-pulled-in-every-step",
        "vssm_gym/envs/robots/holonomic.py",
        "after[2] + self.response.pull * driven",
        "after[2] + self.response.pull * self.max_step",
        (f"{RESPONSE}::test_the_pull_is_the_same_at_every_noise",),
    ),
    Mutant(
        "imagined-robot-that-forgets-its-drive",
        "vssm_gym/envs/world_model/motion.py",
        "return Aim(drawn.body, drawn.rest)",
        "return Aim(drawn.body, rest)",
        (f"{IMAGINED}::test_robots_move_as_the_transition_draws",),
    ),
    Mutant(
        "imagined-robot-of-unknown-motion-at-its-start",
        "vssm_gym/envs/world_model/motion.py",
        "return path.rest[:, -1]",
        "return rest",
        (f"{IMAGINED}::test_robots_move_as_the_transition_draws",),
    ),
    Mutant(
        "wheel-errors-add-up-instead-of-their-variances",
        "vssm_gym/envs/robots/differential.py",
        "math.hypot(noise.slip * travel, noise.play)",
        "(abs(noise.slip * travel) + noise.play)",
        (f"{WHEELS}::test_wheel_errors_are_independent_with_the_stated_deviations",),
    ),
    Mutant(
        "imu-noise-density-without-the-rate",
        "vssm_gym/envs/sensors/imu.py",
        "self._density / math.sqrt(dt) * white",
        "self._density * math.sqrt(dt) * white",
        ("tests/envs/sensors/test_imu_sensor.py::test_white_noise_is_its_density_times_the_root_of_the_rate",),
    ),
)
