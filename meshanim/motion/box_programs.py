"""Quadratic programs over the box [0, 1], many with one matrix: what a blendshape solve comes down to."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Int8
from scipy.optimize import lsq_linear

from meshanim.errors import BackendError, OptionError

try:
    from meshanim import _native
except ImportError:  # the extension is optional; `chosen_backend` says so
    _native = None

__all__ = ["Backend", "BoxPrograms", "ProgramState", "chosen_backend"]

EQUAL = 1e-9
"""As in native/boxqp/solve.kernel.cpp."""

Backend = Literal["auto", "native", "reference"]


def chosen_backend(backend: Backend) -> Literal["native", "reference"]:
    """native where the extension is built, or what was asked for.

    Raises
    ------
    BackendError
        If native was asked for and is not built.
    OptionError
        If there is no such backend.
    """
    if backend not in ("auto", "native", "reference"):
        raise OptionError(f"no backend {backend!r}; there are auto, native, reference")
    if backend == "native" and _native is None:
        raise BackendError("the native extension is not built: install meshanim where a C++17 compiler is")
    return "reference" if backend == "reference" or _native is None else "native"


@dataclass
class ProgramState:
    """What one frame hands to the next: its weights, and which of them were at a bound."""

    previous: Float[np.ndarray, " n"]
    bound: Int8[np.ndarray, " n"]
    """-1 at zero, 1 at one, 0 between: where the next solve begins. Changes its time, not its result."""

    @classmethod
    def start(cls, n: int) -> "ProgramState":
        return cls(np.zeros(n), np.full(n, -1, np.int8))


@dataclass(frozen=True)
class BoxPrograms:
    """min_w w'Gw / 2 - b'w over 0 <= w <= 1 for any number of b, one after another.

    Parameters
    ----------
    gram : (n, n) float64
        G, symmetric and positive definite.
    pairs : (k, 2) int32
        Weights that exclude each other: after a first solve the smaller of each pair (the second, if they
        are equal to 1e-9) is held at zero and the rest solved again.
    feedback : (n, n) float64, optional
        F: b becomes b + F w_previous, which makes each program depend on the one before.
    extra : (n, n) float64, optional
        E: G becomes G + strength E, with a strength a program.
    """

    gram: Float[np.ndarray, "n n"]
    pairs: Int[np.ndarray, "k 2"]
    feedback: Float[np.ndarray, "n n"] | None = None
    extra: Float[np.ndarray, "n n"] | None = None

    def solve(
        self,
        linear: Float[np.ndarray, "frames n"],
        state: ProgramState,
        strength: Float[np.ndarray, " frames"] | None = None,
        backend: Backend = "auto",
    ) -> Float[np.ndarray, "frames n"]:
        """Solve for each row b of `linear`; advances `state`.

        The native backend pivots blocks of weights between their bounds (Judice and Pires 1994) from where
        the last frame ended, and gives the same bits with any number of threads. The reference is scipy's
        bounded least squares (Stark and Parker 1995) on the Cholesky factor of G.
        """
        if chosen_backend(backend) == "reference":
            return self._reference(linear, state, strength)
        none, n = np.zeros((0, 0)), len(self.gram)
        weights = np.empty((len(linear), n))
        _native.solve_programs(
            self.gram,
            np.ascontiguousarray(linear, np.float64),
            self.pairs,
            none if self.feedback is None else self.feedback,
            none if self.extra is None else self.extra,
            np.zeros(0) if strength is None else np.ascontiguousarray(strength, np.float64),
            state.previous,
            state.bound,
            weights,
            torch.get_num_threads(),
        )
        return weights

    def _reference(
        self, linear: np.ndarray, state: ProgramState, strength: np.ndarray | None
    ) -> Float[np.ndarray, "frames n"]:
        weights = np.zeros(linear.shape)
        for t, b in enumerate(linear):
            gram = self.gram
            if self.extra is not None and strength is not None:
                gram = gram + strength[t] * self.extra
            if self.feedback is not None:
                b = b + self.feedback @ state.previous
            free = np.ones(len(b), bool)
            w = _bounded_least_squares(gram, b, free)
            if len(self.pairs):
                first, second = self.pairs.T
                free[np.where(w[first] < w[second] - EQUAL, first, second)] = False
                w = _bounded_least_squares(gram, b, free)
            weights[t] = state.previous[:] = w
        if len(linear):
            state.bound[:] = np.where(weights[-1] <= 0, -1, np.where(weights[-1] >= 1, 1, 0))
        return weights


def _bounded_least_squares(gram: np.ndarray, b: np.ndarray, free: np.ndarray) -> np.ndarray:
    """With G = R'R the program is |R w - R'^-1 b|^2 / 2 up to a constant; weights not free are zero."""
    w = np.zeros(len(b))
    factor = np.linalg.cholesky(gram[np.ix_(free, free)])
    goal = np.linalg.solve(factor, b[free])
    # Its default number of iterations, one a weight, does not always do.
    w[free] = lsq_linear(factor.T, goal, (0, 1), method="bvls", tol=1e-14, max_iter=100 * len(b)).x
    return w
