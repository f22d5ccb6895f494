"""List errors of the emission, its uncertainty, predicted futures and the map update."""

from tests.mutants.mutant import Mutant

UPDATE, OBSERVATION = "vssm_gym/inference/mapping/map_update.py", "vssm_gym/inference/mapping/observation.py"
EMISSION, UNCERTAINTY = "vssm_gym/model/emission.py", "vssm_gym/model/emission_uncertainty.py"
DENSITY, OF_DENSITY = "vssm_gym/model/emission_density.py", "tests/model/test_emission_density.py"
OF_UPDATE, OF_EMISSION = "tests/inference/test_map_update.py", "tests/model/test_emission.py"
ONE_PIXEL = (f"{OF_UPDATE}::test_one_pixel_by_hand",)

MAPPING = (
    Mutant(
        "map-update-forgets-the-prior",
        UPDATE,
        "return mean + weight / total * (observed - mean), total",
        "return jnp.where(weight > 0.0, observed, mean), total",
        (f"{OF_UPDATE}::test_the_posterior_is_the_dense_one",),
    ),
    Mutant(
        "map-update-adds-the-prior-twice",
        UPDATE,
        "total = precision + weight",
        "total = 2.0 * precision + weight",
        (f"{OF_UPDATE}::test_the_posterior_is_the_dense_one",),
    ),
    Mutant(
        "truncation-band-halved",
        OBSERVATION,
        "truncation = config.truncation * voxel_size",
        "truncation = 0.5 * config.truncation * voxel_size",
        ONE_PIXEL,
    ),
    Mutant(
        "free-space-not-updated",
        OBSERVATION,
        "seen = (d > config.min_depth) & (sdf > -truncation)",
        "seen = (d > config.min_depth) & (jnp.abs(sdf) < truncation)",
        ONE_PIXEL,
    ),
    Mutant(
        "free-space-gets-the-colour-of-the-wall",
        OBSERVATION,
        "weight * (seen & (sdf < truncation))",
        "weight * seen",
        ONE_PIXEL,
    ),
    Mutant(
        "disagreement-of-pose-samples-ignored",
        OBSERVATION,
        "w / samples / (1.0 + variance / OBSERVATION_STD**2),",
        "w / samples,",
        (f"{OF_UPDATE}::test_moments_over_samples_agree_with_float64",),
    ),
    Mutant(
        "hit-one-sample-too-far",
        EMISSION,
        "jnp.where(hit, found - HIT, found), hit",
        "jnp.where(hit, found - HIT + 1, found), hit",
        (f"{OF_EMISSION}::test_search_finds_the_hits_of_the_march",),
    ),
    Mutant(
        "crossing-interpolated-the-wrong-way",
        EMISSION,
        "a * d_k + (1.0 - a) * d_before",
        "a * d_before + (1.0 - a) * d_k",
        (f"{OF_EMISSION}::test_box_room_depths_are_those_computed_by_hand",),
    ),
    Mutant(
        "depth-uncertainty-of-variance-for-std",
        UNCERTAINTY,
        "jnp.sqrt(depth_variance).reshape(shape)",
        "depth_variance.reshape(shape)",
        ("tests/model/test_emission_uncertainty.py::test_depth_std_is_the_surfaces_along_the_ray",),
    ),
    Mutant(
        "surface-variance-does-not-fall-with-readings",
        "vssm_gym/maps/surface_std.py",
        "reading_std**2 / precision",
        "reading_std**2",
        ("tests/maps/test_surface_std.py::test_a_plane_by_hand",),
    ),
    Mutant(
        "pose-errors-of-keyframes-independent",
        "vssm_gym/maps/pose_errors.py",
        "share**2, self.root",
        "share, self.root",
        ("tests/maps/test_pose_errors.py::test_the_variance_is_that_of_the_dense_covariance",),
    ),
    Mutant(
        "map-samples-displaced-too-far",
        "vssm_gym/model/map_samples.py",
        "(0.5 / FREQUENCIES) ** 0.5",
        "(1.0 / FREQUENCIES) ** 0.5",
        ("tests/model/test_map_samples.py::test_the_std_of_the_surface_is_the_stated_one",),
    ),
    Mutant(
        "map-samples-with-surfaces-in-unknown-space",
        "vssm_gym/model/map_samples.py",
        "jnp.where(seen, m.occupancy_at(q), PRIOR_OCCUPANCY_MEAN)",
        "m.occupancy_at(q)",
        ("tests/model/test_map_samples.py::test_what_was_not_observed_stays_so",),
    ),
    Mutant(
        "absent-readings-cost-nothing",
        DENSITY,
        "_log(1.0 - shares.miss) + given, _log(shares.miss))",
        "_log(1.0 - shares.miss) + given, 0.0)",
        (f"{OF_DENSITY}::test_the_density_integrates_to_one",),
    ),
    Mutant(
        "emission-without-truncation",
        DENSITY,
        " - jnp.log(2.0 * scale) - jnp.log(jnp.maximum(inside, TINY))",
        " - jnp.log(2.0 * scale)",
        (f"{OF_DENSITY}::test_the_density_is_that_of_the_definition",),
    ),
    Mutant(
        "outliers-of-colour-by-channel",
        DENSITY,
        "rgb = _log_mixture(_log_mixture(plain, textured, scales.textured), 0.0, shares.rgb_outlier)",
        "rgb = 3.0 * _log_mixture(_log_mixture(plain, textured, scales.textured) / 3.0, 0.0, shares.rgb_outlier)",
        (f"{OF_DENSITY}::test_the_density_is_that_of_the_definition",),
    ),
    Mutant(
        "std-of-the-map-as-a-laplace-scale",
        DENSITY,
        "scales.depth_at(location) ** 2 + 0.5 * std**2",
        "scales.depth_at(location) ** 2 + std**2",
        (f"{OF_DENSITY}::test_the_density_is_that_of_the_definition",),
    ),
    Mutant(
        "crps-of-the-left-side-alone",
        "eval/bench/prediction/scores.py",
        "((-1.0, 0.0), (1.0, 1.0))",
        "((-1.0, 0.0), (1.0, 0.0))",
        ("tests/eval/bench/test_prediction_scores.py::test_the_crps_of_a_laplace_distribution",),
    ),
    Mutant(
        "mixture-without-the-probability-of-a-reading",
        "eval/bench/prediction/mixture.py",
        "weight = emission_density.reading_prob(prediction.images, prediction.scales)",
        "weight = jnp.ones_like(prediction.images.depth)",
        ("tests/eval/bench/test_prediction_mixture.py::test_distribution_functions_are_conditional_on_a_reading",),
    ),
    Mutant(
        "density-of-a-pose-in-units-of-its-spread",
        "eval/bench/prediction/ahead/states.py",
        "correlation) - jnp.sum(jnp.log(stds), axis=-1)",
        "correlation)",
        (
            "tests/eval/bench/test_prediction_ahead.py"
            "::test_the_density_of_a_pose_is_that_of_the_gaussian_in_the_tangent",
        ),
    ),
    Mutant(
        "predicted-images-with-the-variance-of-a-normal",
        "vssm_gym/model/predictive.py",
        "2.0 * scales.depth_at(depth) ** 2",
        "scales.depth_at(depth) ** 2",
        ("tests/model/test_model.py::test_image_summaries_by_hand",),
    ),
    Mutant(
        "map-entropy-in-bits",
        "vssm_gym/model/posterior.py",
        "np.sum(np.log(float(prior) / known))",
        "np.sum(np.log2(float(prior) / known))",
        ("tests/model/test_posterior.py::test_entropies_are_those_of_the_parts",),
    ),
)
