"""List errors of the emission, its uncertainty, predicted futures and the map update."""

from tests.mutants.mutant import Mutant

UPDATE, OBSERVATION = "vssm_gym/inference/mapping/map_update.py", "vssm_gym/inference/mapping/observation.py"
EMISSION, UNCERTAINTY = "vssm_gym/model/emission.py", "vssm_gym/model/emission_uncertainty.py"
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
        "laplace-density-not-normalised",
        EMISSION,
        "/ scales.depth - jnp.log(2.0 * scales.depth)",
        "/ scales.depth - jnp.log(scales.depth)",
        (f"{OF_EMISSION}::test_log_prob_is_a_product_of_laplace_densities",),
    ),
    Mutant(
        "depth-uncertainty-of-variance-for-std",
        UNCERTAINTY,
        "jnp.sqrt(depth_variance).reshape(shape)",
        "depth_variance.reshape(shape)",
        ("tests/model/test_emission_uncertainty.py::test_a_wall_by_hand",),
    ),
    Mutant(
        "cell-variance-does-not-fall-with-observations",
        UNCERTAINTY,
        "self.depth**2 / (precision * self.counted**2)",
        "self.depth**2 / self.counted**2",
        ("tests/model/test_emission_uncertainty.py::test_more_measurements_reduce_the_uncertainty",),
    ),
    Mutant(
        "predicted-images-with-the-variance-of-a-normal",
        "vssm_gym/model/predictive.py",
        "spread + 2.0 * jnp.asarray(scale) ** 2",
        "spread + jnp.asarray(scale) ** 2",
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
