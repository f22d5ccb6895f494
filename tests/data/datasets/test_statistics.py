"""Test the statistics of features: joined ones are those of all values at once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vssm_gym.data.datasets.statistics import Moments

ROWS = arrays.arrays(np.float32, st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(-1e3, 1e3, width=32))
IMAGES = arrays.arrays(np.uint8, st.tuples(st.integers(1, 4), st.just(5), st.just(4), st.just(3)))


def assert_close(found, values, axes):
    for name, wanted in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
        np.testing.assert_allclose(np.squeeze(found[name]), wanted(values, axis=axes), rtol=1e-6, atol=1e-4)


@given(st.lists(ROWS, min_size=1, max_size=4))
def test_joined_moments_are_those_of_all_values(parts):
    joined = Moments.of(parts[0])
    for part in parts[1:]:
        joined = joined.with_more(Moments.of(part))
    values = np.concatenate(parts)
    assert joined.count == len(values)
    assert_close(joined.as_json(), values.astype(float), 0)


@given(IMAGES, IMAGES)
def test_images_are_counted_by_channel(first, second):
    found = Moments.of_images(first).with_more(Moments.of_images(second)).as_json()
    assert np.shape(found["mean"]) == (3, 1, 1)
    assert_close(found, np.concatenate([first, second]) / 255.0, (0, 1, 2))
