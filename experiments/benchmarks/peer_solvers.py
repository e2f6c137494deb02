"""The joint problem with given SDs, and how the usual solvers solve it: peers of solver_peers.py.

It is what ``jaxcal.calibrate_batch(problems, sigma=...)`` minimises. With q_i = X^-1 B_i^-1 c the
target in image i's frame, and (x_i, r_i) its measured lateral position and range, over X and c

    sum_i (q_x - x_i)^2 / s_x^2 + (hypot(q_y, q_z) - r_i)^2 / s_r^2 + q_y^2 / s_y^2.

The offsets are q_y: there are 9 unknowns, and nothing to eliminate. Every peer gets the same
problems, a start, an exact Jacobian, and hands back X and c, from which objective and gradient
cosine are computed alike for all.
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

UNKNOWNS = 9
RESIDUALS = 3
"""Of an image."""


@dataclass(frozen=True)
class Batch:
    """Problems with their starts.

    Attributes:
        poses: (b, n, 4, 4) probe -> tracker, mm.
        points: (b, n, 2) lateral position and range, mm.
        matrix: (b, 4, 4) start of X, mm.
        point: (b, 3) start of c, mm.
        sigma: SDs of lateral position, range and offset, mm.
    """

    poses: np.ndarray
    points: np.ndarray
    matrix: np.ndarray
    point: np.ndarray
    sigma: tuple[float, float, float]

    def __len__(self) -> int:
        return len(self.poses)

    def first(self, count: int) -> Batch:
        """The first so many problems."""
        names = ("poses", "points", "matrix", "point")
        return replace(self, **{name: getattr(self, name)[:count] for name in names})


@dataclass(frozen=True)
class Solved:
    """What a solver hands back.

    Attributes:
        matrix: (b, 4, 4) X, mm.
        point: (b, 3) c, mm.
        iterations: (b,).
        seconds: that the batch took.
    """

    matrix: np.ndarray
    point: np.ndarray
    iterations: np.ndarray
    seconds: float


def residuals(batch: Batch, k: int, matrix: np.ndarray, point: np.ndarray) -> tuple[Any, ...]:
    """Residuals (n, 3) of a problem in SDs, and q (n, 3)."""
    poses, (lateral, distance) = batch.poses[k], batch.points[k].T
    in_probe = np.einsum("nji,nj->ni", poses[:, :3, :3], point - poses[:, :3, 3])
    q = (in_probe - matrix[:3, 3]) @ matrix[:3, :3]
    away = np.stack([q[:, 0] - lateral, np.hypot(q[:, 1], q[:, 2]) - distance, q[:, 1]], axis=1)
    return away / np.asarray(batch.sigma), q


def linearise(
    batch: Batch, k: int, matrix: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n, 3) and Jacobian (n, 3, 9) along v, omega and c."""
    residual, q = residuals(batch, k, matrix, point)
    moved = np.zeros((len(q), 3, UNKNOWNS))
    moved[:, [0, 1, 2], [0, 1, 2]] = -1
    moved[:, 0, 4], moved[:, 0, 5] = -q[:, 2], q[:, 1]
    moved[:, 1, 3], moved[:, 1, 5] = q[:, 2], -q[:, 0]
    moved[:, 2, 3], moved[:, 2, 4] = -q[:, 1], q[:, 0]
    moved[:, :, 6:9] = np.einsum("ji,nkj->nik", matrix[:3, :3], batch.poses[k][:, :3, :3])
    far = np.hypot(q[:, 1], q[:, 2])[:, None]
    jacobian = np.stack(
        [moved[:, 0], (q[:, 1:2] * moved[:, 1] + q[:, 2:] * moved[:, 2]) / far, moved[:, 1]],
        axis=1,
    )
    return residual, jacobian / np.asarray(batch.sigma)[:, None]


def judge(batch: Batch, solved: Solved) -> tuple[np.ndarray, np.ndarray]:
    """Objective (b,) and gradient cosine max |g_k| / (|J_k| |r|) (b,) where a solver stopped."""
    cost, cosine = np.empty(len(solved.matrix)), np.empty(len(solved.matrix))
    for k in range(len(cost)):
        residual, jacobian = linearise(batch, k, solved.matrix[k], solved.point[k])
        cost[k] = (residual**2).sum()
        gradient = np.einsum("nri,nr->i", jacobian, residual)
        length = np.sqrt((jacobian**2).sum(axis=(0, 1)))
        cosine[k] = np.abs(gradient / length).max() / np.sqrt(cost[k])
    return cost, cosine


class _Flat:
    """One problem as a function of x = (v, omega, c) about its start."""

    def __init__(self, batch: Batch, k: int) -> None:
        self.batch, self.k, self.images = batch, k, batch.points.shape[1]

    def place(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """X and c at x."""
        start = self.batch.matrix[self.k]
        matrix = start.copy()
        matrix[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(x[3:6]).as_matrix()
        matrix[:3, 3] += start[:3, :3] @ x[:3]
        return matrix, self.batch.point[self.k] + x[6:]

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Residuals (3 n,) alone, for solvers that difference them."""
        return residuals(self.batch, self.k, *self.place(x))[0].ravel()

    def both(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (3 n,) and Jacobian (3 n, 9)."""
        residual, jacobian = linearise(self.batch, self.k, *self.place(x))
        # v is along the start's axes, and omega's own increments pass the right Jacobian of SO(3).
        back = Rotation.from_rotvec(x[3:6]).as_matrix()
        jacobian[..., :3] = jacobian[..., :3] @ back.T
        jacobian[..., 3:6] = jacobian[..., 3:6] @ _right_jacobian(x[3:6])
        return residual.ravel(), jacobian.reshape(-1, UNKNOWNS)


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
    matrix, point = (np.array(part) for part in zip(*places, strict=True))
    return Solved(matrix, point, np.array([count for _, count in found]), seconds)


def scipy_solver(
    method: str, tolerance: float = 1e-12, exact: bool = True
) -> Callable[[Batch], Solved]:
    """scipy.optimize.least_squares, ``lm`` (MINPACK) or ``trf``.

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
            (lambda x: at(x)[0]) if exact else problem.residual, np.zeros(UNKNOWNS),
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
            self.set_num_residuals(RESIDUALS * problem.images)
            self.set_parameter_block_sizes([UNKNOWNS])

        def Evaluate(self, parameters, residuals, jacobians):
            value, jacobian = self.problem.both(np.asarray(parameters[0]))
            residuals[:] = value
            if jacobians is not None:
                jacobians[0][:] = jacobian.ravel()
            return True

    def one(problem: _Flat) -> tuple[np.ndarray, int]:
        x = np.zeros(UNKNOWNS)
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


def optimistix_solver(batch: Batch, tolerance: float) -> Callable[[Batch], Solved]:
    """Levenberg-Marquardt of optimistix, vmapped and compiled.

    Args:
        batch: of the size that will be solved (it is compiled here).
        tolerance: relative; a hundredth of it is the absolute one.
    """
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    from jaxcal.data.geometry import rotation_from_vector

    sigma = jnp.asarray(batch.sigma)

    def residual(x, args):
        poses, points, matrix, point = args
        turn = matrix[:3, :3] @ rotation_from_vector(x[3:6])
        shift = matrix[:3, 3] + matrix[:3, :3] @ x[:3]
        in_probe = jnp.einsum("nji,nj->ni", poses[:, :3, :3], point + x[6:] - poses[:, :3, 3])
        q = (in_probe - shift) @ turn
        lateral, distance = points.T
        far = jnp.hypot(q[:, 1], q[:, 2])
        return jnp.stack([q[:, 0] - lateral, far - distance, q[:, 1]], axis=1) / sigma

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=1e-2 * tolerance)

    @jax.jit
    @jax.vmap
    def solve(poses, points, matrix, point):
        start = jnp.zeros(UNKNOWNS)
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
        matrix, point = (np.array(part) for part in zip(*places, strict=True))
        return Solved(matrix, point, np.asarray(steps), seconds)

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
        solver: ``schur`` (DENSE_SCHUR, the target eliminated), ``normal``
            (DENSE_NORMAL_CHOLESKY) or ``tiny`` (TinySolver).
        tolerance: function tolerance.
        repeats: solves of the whole batch; the median time counts.
    """

    def run(batch: Batch) -> Solved:
        count, images = batch.points.shape[:2]
        affine = batch.poses[:, :, :3].reshape(count, images, 12)
        rows = np.concatenate([affine, batch.points], axis=2).reshape(count, -1)
        start = np.concatenate([batch.matrix[:, :3].reshape(count, 12), batch.point, rows], axis=1)
        head = np.array([count, images, *batch.sigma], dtype=float)
        with tempfile.TemporaryDirectory() as folder:
            problems, results = Path(folder) / "problems", Path(folder) / "results"
            np.concatenate([head, start.ravel()]).tofile(problems)
            subprocess.run(
                [program, problems, results, solver, repr(tolerance), str(repeats)], check=True
            )
            out = np.fromfile(results)
        each = out[:-repeats].reshape(count, 17)
        matrix = np.tile(np.eye(4), (count, 1, 1))
        matrix[:, :3] = each[:, :12].reshape(count, 3, 4)
        seconds = float(np.median(out[-repeats:]))
        return Solved(matrix, each[:, 12:15], each[:, -1].astype(int), seconds)

    return run


def missing(package: str) -> bool:
    """Whether a peer's package is not installed."""
    return importlib.util.find_spec(package) is None
