import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from trigpoint.models.matching import match_mutual


def unit(seed: int, num: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(num, 16)).astype(np.float32)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 40), m=st.integers(0, 40))
def test_matches_are_each_others_nearest_neighbours(seed: int, n: int, m: int) -> None:
    query, anchor = unit(seed, n), unit(seed + 1, m)
    matches, similarities = match_mutual(query, anchor)
    table = query @ anchor.T
    expected = {
        (i, j)
        for i in range(n)
        for j in range(m)
        if table[i, j] == table[i].max() and table[i, j] == table[:, j].max()
    }
    assert {(int(i), int(j)) for i, j in matches} == expected
    assert (np.diff(similarities) <= 0).all()
    np.testing.assert_array_equal(similarities, table[matches[:, 0], matches[:, 1]])


def test_a_shuffled_copy_is_matched_wholly() -> None:
    descriptors = unit(0, 100)
    order = np.random.default_rng(1).permutation(100)
    matches, similarities = match_mutual(descriptors, descriptors[order])
    assert len(matches) == 100
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
    np.testing.assert_allclose(similarities, 1, atol=1e-5)
