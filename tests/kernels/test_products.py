"""Products of matrices are summed in order, by the compiler's function and by XLA."""

import jax
import numpy as np
import pytest

from iblf_jax.kernels import cpu
from iblf_jax.kernels.products import MIN_TERMS_OF_CALL, matmul_in_order
from iblf_jax.kernels.toolchain import ToolchainError


@pytest.mark.parametrize("has_compiler", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_products_of_batches_and_their_derivatives(monkeypatch, has_compiler, dtype):
    if not has_compiler:

        def fails(name):
            raise ToolchainError(name)

        monkeypatch.setattr(cpu, "array_function", fails)
    rng, m, n, p = np.random.default_rng(0), 3, MIN_TERMS_OF_CALL + 1, 5
    left, right = (
        rng.normal(size=(4, 2, m, n)).astype(dtype),
        rng.normal(size=(2, n, p)).astype(dtype),
    )
    left[2:] = left[1]  # copies of the entry before
    over_both = jax.vmap(jax.vmap(matmul_in_order), in_axes=(0, None))
    called = jax.jit(lambda x, y: over_both(x, y))
    assert ("iblf_jax_multiply" in called.lower(left, right).as_text()) == has_compiler
    found, exact = np.asarray(called(left, right)), left.astype(float) @ right.astype(float)
    np.testing.assert_allclose(found, exact, rtol=0, atol=50 * np.finfo(dtype).eps)
    single = np.asarray(jax.jit(matmul_in_order)(left[3, 1], right[1]))
    np.testing.assert_array_equal(found[3, 1], single)
    _, tangent = jax.jvp(called, (left, right), (left, 2.0 * right))
    np.testing.assert_allclose(tangent, 3.0 * found, rtol=0, atol=200 * np.finfo(dtype).eps)
