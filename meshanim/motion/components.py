"""Principal components of motion that does not fit into memory."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from meshanim.errors import OptionError, ShapeError

__all__ = ["PrincipalComponents", "principal_components"]

OVERSAMPLING = 16
Blocks = Callable[[], Iterable[Float[np.ndarray, "frames numbers"]]]


@dataclass(frozen=True)
class PrincipalComponents:
    """x is about mean + coefficients @ components.

    Parameters
    ----------
    mean : (N,)
        Of all rows.
    components : (K, N)
        Orthonormal rows, by falling variance; each one's largest entry is positive.
    deviation : (K,)
        Root mean square of each coefficient.
    explained : float
        Share of the variance that they hold, 0 to 1.
    """

    mean: Float[np.ndarray, " numbers"]
    components: Float[np.ndarray, "components numbers"]
    deviation: Float[np.ndarray, " components"]
    explained: float


def principal_components(
    blocks: Blocks, count: int, variance: float = 1.0, passes: int = 4, seed: int = 0
) -> PrincipalComponents:
    """Principal components by randomised subspace iteration (Halko et al., SIAM Review 2011, Alg. 4.4).

    The data are read `passes` + 2 times, a block at a time: memory holds one block and `count` + 16 rows,
    however many frames there are.

    Parameters
    ----------
    blocks : callable
        Gives the rows anew each time it is called, in blocks (frames, N).
    count : int
        Components at most; fewer where there are fewer rows or columns.
    variance : float
        Share of the variance at which to stop earlier, (0, 1].
    passes : int
        Iterations; each divides what is missing of component k by (s_k / s_(count + 16))^2.
    seed : int
        Of the first subspace.

    Raises
    ------
    OptionError
        If count or variance is out of range.
    ShapeError
        If there are no rows, or a number is not finite.
    """
    if count < 1 or not 0 < variance <= 1 or passes < 1:
        raise OptionError(f"{count} components, variance {variance}, {passes} passes: out of range")
    rows, total, mean = 0, 0.0, np.zeros(0)
    for block in blocks():
        if not np.isfinite(block).all():
            raise ShapeError("the motion holds NaN or infinity: clean it first")
        # Sums of squares about a running mean (Chan et al. 1983): no cancellation.
        part, fresh = len(block), np.asarray(block, np.float64)
        if part == 0:
            continue
        own = fresh.mean(0)
        step = own - (mean if rows else own)
        total += float(np.square(fresh - own).sum()) + float(step @ step) * rows * part / (rows + part)
        mean = own if rows == 0 else mean + step * (part / (rows + part))
        rows += part
    if rows == 0:
        raise ShapeError("there is no motion to take components of")
    size = min(count + OVERSAMPLING, len(mean), rows)
    if total <= 1e-20 * rows:
        return PrincipalComponents(mean, np.zeros((0, len(mean))), np.zeros(0), 1.0)
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(mean), size)))[0]
    for _ in range(passes):
        product = np.zeros_like(basis)
        for block in blocks():
            centred = block - mean
            product += centred.T @ (centred @ basis)
        basis = np.linalg.qr(product)[0]
    small = np.zeros((size, size))
    for block in blocks():
        coefficients = (block - mean) @ basis
        small += coefficients.T @ coefficients
    values, vectors = np.linalg.eigh(small)
    values, vectors = values[::-1].clip(0), vectors[:, ::-1]
    known = int(np.count_nonzero(values > 1e-12 * values[0]))
    share = np.cumsum(values) / total
    # The last component that is needed, of those that are more than rounding.
    needed = int(np.searchsorted(share, variance - 1e-12)) + 1
    keep = min(count, known, needed)
    components = (basis @ vectors[:, :keep]).T
    largest = np.take_along_axis(components, np.abs(components).argmax(1)[:, None], 1)
    return PrincipalComponents(
        mean,
        components * np.sign(largest),
        np.sqrt(values[:keep] / rows),
        float(min(share[keep - 1], 1.0)),
    )
