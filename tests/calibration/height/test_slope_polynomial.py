"""Terms of the polynomial from colour to slope."""

import itertools

import numpy as np

from calibration.height.slope_polynomial import COLOUR_SCALE, TERMS, inverse_features


def test_the_terms_are_all_products_of_at_most_three() -> None:
    rng = np.random.default_rng(0)
    change, (x, y) = rng.normal(0, 0.3, (40, 3)), rng.uniform(-1, 1, (2, 40))
    inputs = [*(COLOUR_SCALE * change).T, x, y]
    products = [
        np.prod([np.ones(40), *factors], axis=0)
        for order in range(4)
        for factors in itertools.combinations_with_replacement(inputs, order)
    ]
    found = inverse_features(change, x, y)
    assert found.shape == (40, TERMS) == (40, len(products))
    np.testing.assert_allclose(np.array(sorted(found.T.tolist())), np.array(sorted(p.tolist() for p in products)))
