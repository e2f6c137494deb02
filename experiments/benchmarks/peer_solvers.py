"""The explicit joint problem, and how the usual solvers solve it: the peers of solver_peers.py.

Per image, with q_i = X^-1 B_i^-1 c and p_i(y) = (x_i, y, sqrt(r_i^2 - y^2)), minimise over X, c, y

    sum_i |w * (q_i - p_i(y_i))|^2 + (e y_i)^2.

Every peer gets the same problems, the same start and an exact Jacobian, and hands back X, c and y,
from which objective and gradient cosine are computed alike for all.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import subprocess
import tempfile
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

LARGEST = 0.95
"""Offsets stay below this fraction of the range, as in jaxcal."""


@dataclass(frozen=True)
class Batch:
    """Problems with their starts; mm.

    Attributes:
        poses: (b, n, 4, 4) probe -> tracker. points: (b, n, 2) lateral, range. matrix: (b, 4, 4)
            start of X. point: (b, 3) start of c. weight: (3,) one over the SD of each component of
            q - p. elevation_weight: one over the SD of the offsets.
    """

    poses: np.ndarray
    points: np.ndarray
    matrix: np.ndarray
    point: np.ndarray
    weight: np.ndarray
    elevation_weight: float

    def __len__(self) -> int:
        return len(self.poses)

    def first(self, count: int) -> Batch:
        """The first so many problems."""
        names = ("poses", "points", "matrix", "point")
        return replace(self, **{name: getattr(self, name)[:count] for name in names})


@dataclass(frozen=True)
class Solved:
    """What a solver hands back: X (b, 4, 4), c (b, 3), y (b, n), iterations (b,) and seconds."""

    matrix: np.ndarray
    point: np.ndarray
    offset: np.ndarray
    iterations: np.ndarray
    seconds: float


def linearise(
    batch: Batch, k: int, matrix: np.ndarray, point: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 4) and Jacobian (n, 4, 10) along v, omega, c and the image's own offset."""
    poses, (lateral, distance) = batch.poses[k], batch.points[k].T
    turn, shift = matrix[:3, :3], matrix[:3, 3]
    in_probe = np.einsum("nji,nj->ni", poses[:, :3, :3], point - poses[:, :3, 3])
    q = (in_probe - shift) @ turn
    axial = np.sqrt(np.maximum(distance**2 - offset**2, (1e-6 * distance) ** 2))
    w, e = batch.weight, batch.elevation_weight
    residual = np.empty((len(poses), 4))
    residual[:, :3] = w * (q - np.stack([lateral, offset, axial], axis=1))
    residual[:, 3] = e * offset
    jacobian = np.zeros((len(poses), 4, 10))
    jacobian[:, [0, 1, 2], [0, 1, 2]] = -w
    jacobian[:, 0, 4], jacobian[:, 0, 5] = -w[0] * q[:, 2], w[0] * q[:, 1]
    jacobian[:, 1, 3], jacobian[:, 1, 5] = w[1] * q[:, 2], -w[1] * q[:, 0]
    jacobian[:, 2, 3], jacobian[:, 2, 4] = -w[2] * q[:, 1], w[2] * q[:, 0]
    jacobian[:, :3, 6:9] = w[:, None] * np.einsum("ji,nkj->nik", turn, poses[:, :3, :3])
    jacobian[:, 1, 9], jacobian[:, 2, 9], jacobian[:, 3, 9] = -w[1], w[2] * offset / axial, e
    return residual, jacobian


def judge(batch: Batch, solved: Solved) -> tuple[np.ndarray, np.ndarray]:
    """Objective (b,) and gradient cosine max |g_k| / (|J_k| |r|) (b,) where a solver stopped."""
    cost, cosine = np.empty(len(solved.matrix)), np.empty(len(solved.matrix))
    for k in range(len(cost)):
        args = solved.matrix[k], solved.point[k], solved.offset[k]
        residual, jacobian = linearise(batch, k, *args)
        cost[k] = (residual**2).sum()
        shared = np.einsum("nri,nr->i", jacobian[..., :9], residual)
        length = np.sqrt((jacobian[..., :9] ** 2).sum(axis=(0, 1)))
        own = (jacobian[..., 9] * residual).sum(axis=1)
        own_length = np.sqrt((jacobian[..., 9] ** 2).sum(axis=1))
        largest = max(np.abs(shared / length).max(), np.abs(own / own_length).max())
        cosine[k] = largest / np.sqrt(cost[k])
    return cost, cosine


class _Flat:
    """One problem as a function of x = (v, omega, c, y) about its start, for dense solvers."""

    def __init__(self, batch: Batch, k: int) -> None:
        self.batch, self.k, self.images = batch, k, batch.points.shape[1]
        self.size = 9 + self.images

    def place(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """X, c and y at x."""
        start = self.batch.matrix[self.k]
        matrix = start.copy()
        matrix[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(x[3:6]).as_matrix()
        matrix[:3, 3] += start[:3, :3] @ x[:3]
        return matrix, self.batch.point[self.k] + x[6:9], x[9:]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Residuals (4 n,) alone, for solvers that difference them."""
        batch, k = self.batch, self.k
        matrix, point, offset = self.place(x)
        lateral, distance = batch.points[k].T
        poses = batch.poses[k]
        in_probe = np.einsum("nji,nj->ni", poses[:, :3, :3], point - poses[:, :3, 3])
        q = (in_probe - matrix[:3, 3]) @ matrix[:3, :3]
        axial = np.sqrt(np.maximum(distance**2 - offset**2, (1e-6 * distance) ** 2))
        residual = np.empty((self.images, 4))
        residual[:, :3] = batch.weight * (q - np.stack([lateral, offset, axial], axis=1))
        residual[:, 3] = batch.elevation_weight * offset
        return residual.ravel()

    def both(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (4 n,) and dense Jacobian (4 n, 9 + n)."""
        residual, jacobian = linearise(self.batch, self.k, *self.place(x))
        dense = np.zeros((self.images, 4, self.size))
        shared = jacobian[..., :9].copy()
        # v is along the start's axes, and omega's own increments pass the right Jacobian of SO(3).
        back = Rotation.from_rotvec(x[3:6]).as_matrix()
        shared[..., :3] = shared[..., :3] @ back.T
        shared[..., 3:6] = shared[..., 3:6] @ _right_jacobian(x[3:6])
        dense[..., :9] = shared
        dense[np.arange(self.images), :, 9 + np.arange(self.images)] = jacobian[..., 9]
        return residual.ravel(), dense.reshape(-1, self.size)


def _right_jacobian(turn: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-6:
        return np.eye(3) - cross / 2 + cross @ cross / 6
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) - first * cross + second * cross @ cross


def _one_by_one(batch: Batch, solve: Callable[[_Flat], tuple[np.ndarray, int]]) -> Solved:
    problems = [_Flat(batch, k) for k in range(len(batch))]
    begun = time.perf_counter()
    found = [solve(problem) for problem in problems]
    seconds = time.perf_counter() - begun
    places = [problem.place(x) for problem, (x, _) in zip(problems, found, strict=True)]
    matrix, point, offset = (np.array(part) for part in zip(*places, strict=True))
    return Solved(matrix, point, offset, np.array([count for _, count in found]), seconds)


def scipy_solver(
    method: str, tolerance: float = 1e-12, exact: bool = True
) -> Callable[[Batch], Solved]:
    """scipy.optimize.least_squares, ``lm`` (MINPACK) or ``trf``.

    Unknowns are not scaled by their columns: that took more evaluations here (10.1 against 8.2 of
    ``lm`` at 1e-12), and left one problem of 64 where an offset had reached its range.

    Args:
        method: scipy's name.
        tolerance: ftol, xtol and gtol.
        exact: with the exact, vectorised Jacobian; else with scipy's forward differences.
    """

    def one(problem: _Flat) -> tuple[np.ndarray, int]:
        last: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            key = x.tobytes()
            if key not in last:
                last.clear()
                last[key] = problem.both(x)
            return last[key]

        found = least_squares(
            (lambda x: at(x)[0]) if exact else problem.residual, np.zeros(problem.size),
            jac=(lambda x: at(x)[1]) if exact else "2-point",  # pyright: ignore[reportArgumentType]
            method=method, x_scale=1.0, ftol=tolerance, xtol=tolerance, gtol=tolerance,  # pyright: ignore[reportArgumentType]
        )  # fmt: skip
        return found.x, int(found.nfev)

    return lambda batch: _one_by_one(batch, one)


def pyceres_solver(batch: Batch) -> Solved:
    """Ceres through Python: one cost function a problem, written in numpy."""
    # Not among the dependencies: a peer that is there or is not.
    pyceres: Any = importlib.import_module("pyceres")

    class Cost(pyceres.CostFunction):
        def __init__(self, problem: _Flat) -> None:
            super().__init__()
            self.problem = problem
            self.set_num_residuals(4 * problem.images)
            self.set_parameter_block_sizes([problem.size])

        def Evaluate(self, parameters, residuals, jacobians):
            value, jacobian = self.problem.both(np.asarray(parameters[0]))
            residuals[:] = value
            if jacobians is not None:
                jacobians[0][:] = jacobian.ravel()
            return True

    def one(problem: _Flat) -> tuple[np.ndarray, int]:
        x = np.zeros(problem.size)
        whole: Any = pyceres.Problem()
        whole.add_residual_block(Cost(problem), None, [x])
        options: Any = pyceres.SolverOptions()
        options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
        options.num_threads = 1
        options.max_num_iterations = 200
        options.function_tolerance = 1e-9
        options.gradient_tolerance = options.parameter_tolerance = 1e-300
        options.minimizer_progress_to_stdout = False
        options.logging_type = pyceres.LoggingType.SILENT
        summary: Any = pyceres.SolverSummary()
        pyceres.solve(options, whole, summary)
        return x, int(summary.num_successful_steps)

    return _one_by_one(batch, one)


def optimistix_solver(batch: Batch) -> Callable[[Batch], Solved]:
    """Levenberg-Marquardt of optimistix on all 9 + n unknowns, dense, vmapped and compiled.

    Args:
        batch: of the size that will be solved (it is compiled here).
    """
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    from jaxcal.geometry import rotation_from_vector

    weight, elevation_weight = jnp.asarray(batch.weight), batch.elevation_weight

    def residual(x, args):
        poses, points, matrix, point = args
        turn = matrix[:3, :3] @ rotation_from_vector(x[3:6])
        shift = matrix[:3, 3] + matrix[:3, :3] @ x[:3]
        in_probe = jnp.einsum("nji,nj->ni", poses[:, :3, :3], point + x[6:9] - poses[:, :3, 3])
        q = (in_probe - shift) @ turn
        lateral, distance = points.T
        offset = x[9:]
        axial = jnp.sqrt(jnp.maximum(distance**2 - offset**2, (1e-6 * distance) ** 2))
        error = weight * (q - jnp.stack([lateral, offset, axial], axis=1))
        return error, elevation_weight * offset

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-10)

    @jax.jit
    @jax.vmap
    def solve(poses, points, matrix, point):
        start = jnp.zeros(9 + points.shape[0])
        args = (poses, points, matrix, point)
        found = optx.least_squares(residual, solver, start, args=args, throw=False, max_steps=256)
        return found.value, found.stats["num_steps"]

    parts = (batch.poses, batch.points, batch.matrix, batch.point)
    jax.block_until_ready(solve(*parts))

    def run(batch: Batch) -> Solved:
        begun = time.perf_counter()
        x, steps = jax.block_until_ready(
            solve(batch.poses, batch.points, batch.matrix, batch.point)
        )
        seconds = time.perf_counter() - begun
        places = [_Flat(batch, k).place(row) for k, row in enumerate(np.array(x))]
        matrix, point, offset = (np.array(part) for part in zip(*places, strict=True))
        return Solved(matrix, point, offset, np.asarray(steps), seconds)

    return run


def build_ceres() -> Path | str:
    """Compile the C++ peers; the program, or why there is none."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        return "no cmake or no C++ compiler"
    source = (Path(__file__).parent / "ceres").resolve()
    # cmake refuses a folder that it made for another checkout.
    checkout = f"{zlib.crc32(str(source).encode()):08x}"
    folder = Path(tempfile.gettempdir()) / f"jaxcal-ceres-{os.getuid()}-{checkout}"
    for command in (
        ["cmake", "-S", str(source), "-B", str(folder), "-DCMAKE_BUILD_TYPE=Release"],
        ["cmake", "--build", str(folder)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return "Ceres 2.1 or newer not found, or its program did not build"
    return folder / "ceres_peers"


def ceres_solver(
    program: Path, solver: str, tolerance: float, repeats: int = 1
) -> Callable[[Batch], Solved]:
    """Ceres in C++, one problem after the other on one thread.

    Args:
        program: from :func:`build_ceres`.
        solver: ``schur`` (DENSE_SCHUR) or ``tiny`` (TinySolver, offsets eliminated by hand).
        tolerance: function tolerance.
        repeats: solves of the whole batch; the median time counts.
    """

    def run(batch: Batch) -> Solved:
        count, images = batch.points.shape[:2]
        affine = batch.poses[:, :, :3].reshape(count, images, 12)
        rows = np.concatenate([affine, batch.points], axis=2).reshape(count, -1)
        start = np.concatenate([batch.matrix[:, :3].reshape(count, 12), batch.point, rows], axis=1)
        head = np.array([count, images, *batch.weight, batch.elevation_weight], dtype=float)
        with tempfile.TemporaryDirectory() as folder:
            problems, results = Path(folder) / "problems", Path(folder) / "results"
            np.concatenate([head, start.ravel()]).tofile(problems)
            subprocess.run(
                [program, problems, results, solver, repr(tolerance), str(repeats)], check=True
            )
            out = np.fromfile(results)
        each = out[:-repeats].reshape(count, 17 + images)
        matrix = np.tile(np.eye(4), (count, 1, 1))
        matrix[:, :3] = each[:, :12].reshape(count, 3, 4)
        seconds = float(np.median(out[-repeats:]))
        return Solved(matrix, each[:, 12:15], each[:, 15:-2], each[:, -1].astype(int), seconds)

    return run


def missing(package: str) -> bool:
    """Whether a peer's package is not installed."""
    return importlib.util.find_spec(package) is None
