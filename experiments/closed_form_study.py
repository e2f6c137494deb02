"""The closed form of Eq. 7 and its certificate against Levenberg-Marquardt from 64 starts.

10^5 random problems of 4 to 50 images, with noise to 10 mm, offsets to 5 mm, degenerate poses and
points among them, and scales known or unknown. For each the study asks whether the answer is above
the best of 64 descents, whether it is certified, whether a certificate is false, whether the bound
holds where it is not certified, and whether a unique answer has a rival.

The descents are an implementation of their own: numpy's pseudo-inverse eliminates target and
origin, and plain Levenberg-Marquardt (no second derivatives) moves rotation and scales from random
starts. They share nothing with jaxcal but the data.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import arguments, batch_of, machine, save_figure, write_table
from jaxtyping import Array, Float

import jaxcal
from jaxcal.io.atomic import atomic_path
from jaxcal.solvers.closed_form.reduced_objective import CONSTRAINTS, ImageData, reduce
from jaxcal.solvers.closed_form.single import solve

SEED = 20261121
PROBLEMS = 100_000
QUICK = 2_000
BLOCK = 2_000
STARTS = 64
FIRST_STEPS = 40
LAST_STEPS = 100
FINISHERS = 16
"""All descents take the first steps; those that are then lowest are run to their end."""
CHUNK = 100
RELATIVE = 1e-9
"""Of the objective: how much lower a descent must be to count."""
FLOOR = 1e-18
"""Of the sum of squares of the data, for exact data, whose objective is rounding."""

ESTIMATES = ((), ("scale",), ("common-scale",), ("sound-speed",))
ESTIMATE_SHARES = (0.5, 0.25, 0.15, 0.1)
FAMILIES = ("general", "wide", "cone", "parallel", "one axis", "duplicates", "collinear")
FAMILY_SHARES = (0.55, 0.1, 0.1, 0.0625, 0.0625, 0.0625, 0.0625)
ORDINARY = ("general", "wide")
NOISES_MM = (0.0, 0.1, 0.5, 2.0, 5.0, 10.0)
OFFSETS_MM = (0.0, 1.0, 5.0)
IMAGES = (4, 5, 6, 8, 10, 12, 16, 20, 30, 50)
"""Half of the problems; the others have any number from 4 to 50."""


@dataclass(frozen=True)
class Drawn:
    """One random problem."""

    family: str
    estimate: tuple[str, ...]
    images: int
    noise: float
    offset: float
    data: ImageData


def _turns(rng: np.random.Generator, axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    cross = np.zeros((len(axes), 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        cross[:, j, i], cross[:, i, j] = axes[:, k], -axes[:, k]
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * cross @ cross


def draw(rng: np.random.Generator) -> Drawn:
    """One problem: the paper's field, rotations to 30 degrees unless its family says otherwise."""
    family = str(rng.choice(FAMILIES, p=FAMILY_SHARES))
    estimate = ESTIMATES[rng.choice(len(ESTIMATES), p=ESTIMATE_SHARES)]
    count = int(rng.choice(IMAGES) if rng.uniform() < 0.5 else rng.integers(4, 51))
    noise, offset = float(rng.choice(NOISES_MM)), float(rng.choice(OFFSETS_MM))
    axes = rng.normal(size=(count, 3))
    largest = {"wide": 180.0, "cone": 3.0, "parallel": 0.0}.get(family, 30.0)
    if family == "one axis":
        axes[:] = axes[0]
    rotations = _turns(rng, axes, np.radians(largest) * rng.uniform(-1, 1, count))
    fixed = _turns(rng, rng.normal(size=(2, 3)), rng.uniform(0, np.pi, 2))
    rotations = rotations @ fixed[0]
    target = np.stack(
        [rng.uniform(-29, 29, count), rng.uniform(-offset, offset, count),
         rng.uniform(10, 90, count)], axis=1,
    )  # fmt: skip
    if family == "collinear":
        target[:, 2] = 50 + rng.uniform(-1, 1) * target[:, 0]
    if family == "duplicates":
        which = np.arange(count) % int(rng.integers(1, max(2, count // 3) + 1))
        rotations, target = rotations[which], target[which]
    in_probe = target @ fixed[1].T + 50 * rng.normal(size=3)
    translations = 100 * rng.normal(size=3) - np.einsum("nij,nj->ni", rotations, in_probe)
    points = target[:, [0, 2]] + noise * rng.normal(size=(count, 2))
    pixels = bool({"scale", "common-scale"} & set(estimate))
    data = ImageData(rotations, translations, points, 0.0, np.ones(2), pixels)
    return Drawn(family, estimate, count, noise, offset, data)


def eliminated(data: ImageData) -> tuple[np.ndarray, float]:
    """A 7x7 triangle whose norm at (x, 1) is Eq. 7's at the best t and c, and the data's size."""
    count = len(data.points)
    eye = np.tile(np.eye(3), (count, 1, 1))
    rest = np.concatenate([data.rotations, -eye], axis=2).reshape(3 * count, 6)
    away = data.translations - data.translations.mean(axis=0)
    moved = data.points - data.points.mean(axis=0)
    u, v = moved[:, :1, None], moved[:, 1:, None]
    columns = np.concatenate([u * data.rotations, v * data.rotations, away[:, :, None]], axis=2)
    columns = columns.reshape(3 * count, 7)
    for _ in range(2):
        columns = columns - rest @ (np.linalg.pinv(rest, rcond=1e-11) @ columns)
    return np.asarray(np.linalg.qr(columns, mode="r")), float(np.sum(away**2) + np.sum(moved**2))


@partial(jax.jit, static_argnums=2)
def descents(
    triangles: Float[Array, "p 7 7"], quaternions: Float[Array, "p s 4"], free: tuple[str, ...]
) -> tuple[Float[Array, "p s"], Float[Array, "p s 6"]]:
    """Levenberg-Marquardt from many rotations; the objectives and x where they end."""
    groups = {(): [], ("common",): [(0, 1)], ("axial",): [(1,)]}.get(free, [(0,), (1,)])
    shared = np.array([[float(axis in group) for axis in range(2)] for group in groups])
    zero = jnp.zeros(3 + len(groups))

    def moved(place: tuple, move: Array) -> tuple[Array, Array]:
        """Quaternion and scales after a turn (rad) and a change of the free log scales."""
        (a, b, d, e), scales = place
        x, y, z = 0.5 * move[:3]
        after = jnp.stack([a - x * b - y * d - z * e, b + x * a + y * e - z * d,
                           d - x * e + y * a + z * b, e + x * d - y * b + z * a])  # fmt: skip
        return after / jnp.linalg.norm(after), scales * jnp.exp(move[3:] @ shared.reshape(-1, 2))

    def point(place: tuple) -> Array:
        (w, x, y, z), scales = place
        first = jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
        third = jnp.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
        return jnp.concatenate([scales[0] * first, scales[1] * third])

    def residual(move: Array, place: tuple, triangle: Array) -> Array:
        return triangle @ jnp.append(point(moved(place, move)), 1.0)

    def cost(place: tuple, triangle: Array) -> Array:
        return jnp.sum(residual(zero, place, triangle) ** 2)

    def step(triangle: Array, state: tuple) -> tuple:
        place, damping, now = state
        jacobian = jax.jacfwd(residual)(zero, place, triangle)
        normal, slope = jacobian.T @ jacobian, jacobian.T @ residual(zero, place, triangle)
        size = jnp.diagonal(normal)
        damped = jnp.diag(damping * size + 1e-14 * (damping * size.sum() + 1e-30))
        move = jnp.linalg.solve(normal + damped, -slope)
        trial = moved(place, move.at[3:].set(jnp.clip(move[3:], -1.0, 1.0)))
        after = cost(trial, triangle)
        better = after < now
        place = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, place)
        damping = jnp.clip(damping * jnp.where(better, 0.3, 4.0), 1e-12, 1e12)
        return place, damping, jnp.where(better, after, now)

    each = jax.vmap(jax.vmap(step, (None, 0)))
    ones = jnp.ones(quaternions.shape[:2])
    place = (quaternions, jnp.ones((*ones.shape, 2)))
    state = (place, 1e-3 * ones, jax.vmap(jax.vmap(cost, (0, None)))(place, triangles))
    state = jax.lax.fori_loop(0, FIRST_STEPS, lambda _, state: each(triangles, state), state)
    lowest = jnp.argsort(state[2], axis=1)[:, :FINISHERS]
    state = jax.tree.map(lambda leaf: jax.vmap(lambda a, k: a[k])(leaf, lowest), state)
    place, _, now = jax.lax.fori_loop(0, LAST_STEPS, lambda _, state: each(triangles, state), state)
    return now, jax.vmap(jax.vmap(point))(place)


def best_of_descents(
    rng: np.random.Generator, drawn: list[Drawn]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """For every problem the lowest objectives and their x, the data's size, and the triangle."""
    parts = [eliminated(each.data) for each in drawn]
    triangles = np.stack([part[0] for part in parts])
    sizes = np.array([part[1] for part in parts])
    values, points = np.zeros((len(drawn), FINISHERS)), np.zeros((len(drawn), FINISHERS, 6))
    for estimate in ESTIMATES:
        where = np.flatnonzero([each.estimate == estimate for each in drawn])
        free = CONSTRAINTS[estimate].free
        for start in range(0, len(where), CHUNK):
            rows = where[start : start + CHUNK]
            quaternions = rng.normal(size=(CHUNK, STARTS, 4))
            quaternions /= np.linalg.norm(quaternions, axis=2, keepdims=True)
            filled = triangles[np.resize(rows, CHUNK)]
            found = descents(jnp.asarray(filled), jnp.asarray(quaternions), free)
            values[rows], points[rows] = (np.asarray(part)[: len(rows)] for part in found)
    return values, points, sizes, triangles


@dataclass
class Outcome:
    """What became of one problem."""

    drawn: Drawn
    objective: float
    best: float
    gap: float
    certified: bool
    unique: bool
    above: bool
    false_certificate: bool
    bound_broken: bool
    false_unique: bool
    milliseconds: float


def judge(
    drawn: Drawn, values: np.ndarray, points: np.ndarray, size: float, triangle: np.ndarray
) -> Outcome:
    """Solve one problem in closed form and compare."""
    start = time.process_time()
    x, certificate = solve(reduce(drawn.data, CONSTRAINTS[drawn.estimate]))
    milliseconds = 1e3 * (time.process_time() - start)
    # Both objectives by the same sum, so that its rounding does not count.
    objective = float(np.sum((triangle @ np.append(x, 1.0)) ** 2))
    best = float(np.nanmin(values))
    slack = RELATIVE * objective + FLOOR * size
    above = objective > best + slack
    rivals = points[values <= objective + slack]
    distance = np.abs(rivals - x).max(axis=1) / np.abs(x).max() if len(rivals) else np.zeros(1)
    # A rival as good that is elsewhere; LM that has not quite arrived is not one.
    far = bool(np.any(distance > 0.05))
    return Outcome(
        drawn=drawn,
        objective=objective,
        best=best,
        gap=certificate.gap_mm2,
        certified=certificate.certified,
        unique=certificate.unique,
        above=above,
        false_certificate=certificate.certified and above,
        bound_broken=best < objective - certificate.gap_mm2 - slack,
        false_unique=certificate.unique and far,
        milliseconds=milliseconds,
    )


def block(index: int, path: Path) -> list[Outcome]:
    """The outcomes of one block of problems; an interrupted study goes on after the last one."""
    rng = np.random.default_rng([SEED, index])
    drawn = [draw(rng) for _ in range(BLOCK)]
    names = [name for name in Outcome.__dataclass_fields__ if name != "drawn"]
    if path.exists():
        rows = json.loads(path.read_text())
        return [Outcome(d, *row) for d, row in zip(drawn, rows, strict=True)]
    parts = zip(drawn, *best_of_descents(rng, drawn), strict=True)
    outcomes = [judge(*each) for each in parts]
    rows = [[getattr(outcome, name) for name in names] for outcome in outcomes]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(rows, default=lambda value: value.item()))
    return outcomes


HEADER = (
    "family", "estimate", "images", "problems", "certified", "certified_share", "unique",
    "above_64_descents", "false_certificates", "broken_bounds", "false_unique",
    "descents_above_closed_form", "median_cpu_ms",
)  # fmt: skip
BINS = ((4, 4), (5, 5), (6, 7), (8, 8), (9, 11), (12, 19), (20, 50), (4, 50))


def rows_of(outcomes: list[Outcome]) -> list[list[object]]:
    """The table: families x estimates x numbers of images, and the totals."""
    rows: list[list[object]] = []
    for family in ("ordinary", *FAMILIES, "all"):
        members = {"ordinary": ORDINARY, "all": FAMILIES}.get(family, (family,))
        for estimate in ("all", *ESTIMATES):
            for low, high in BINS:
                chosen = [
                    o
                    for o in outcomes
                    if o.drawn.family in members
                    and estimate in ("all", o.drawn.estimate)
                    and low <= o.drawn.images <= high
                ]
                if not chosen:
                    continue
                name = estimate if isinstance(estimate, str) else "+".join(estimate) or "none"
                certified = sum(o.certified for o in chosen)
                rows.append([
                    family, name, f"{low}-{high}" if low < high else str(low), len(chosen),
                    certified, f"{certified / len(chosen):.5f}", sum(o.unique for o in chosen),
                    sum(o.above for o in chosen), sum(o.false_certificate for o in chosen),
                    sum(o.bound_broken for o in chosen), sum(o.false_unique for o in chosen),
                    sum(o.best > o.objective * (1 + RELATIVE) + 1e-12 for o in chosen),
                    f"{np.median([o.milliseconds for o in chosen]):.2f}",
                ])  # fmt: skip
    return rows


def draw_figure(outcomes: list[Outcome], path: Path) -> None:
    """Shares certified and shares of single descents that miss the minimum, over the images."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    ordinary = [o for o in outcomes if o.drawn.family in ORDINARY]
    for estimate in ESTIMATES:
        label = "+".join(estimate) or "scales known"
        counts, shares = [], []
        for count in IMAGES:
            chosen = [
                o for o in ordinary if o.drawn.estimate == estimate and o.drawn.images == count
            ]
            if chosen:
                counts.append(count)
                shares.append(np.mean([o.certified for o in chosen]))
        axes[0].plot(counts, shares, "o-", label=label)
    axes[0].set(xlabel="images", ylabel="share certified", title="general and wide poses")
    axes[0].set_xscale("log")
    axes[0].legend()
    for certified in (True, False):
        gaps = [
            (o.drawn.images, max(o.gap / max(o.objective, 1e-300), 1e-18))
            for o in ordinary
            if o.certified == certified and o.objective > 1e-6 and np.isfinite(o.gap)
        ]
        if gaps:
            n, g = np.array(gaps[:20000]).T
            name = "certified" if certified else "not certified"
            axes[1].plot(n, g, ".", markersize=2, label=name)
    axes[1].set(xlabel="images", ylabel="gap / objective", yscale="log", title="proved gap")
    axes[1].legend(markerscale=4)
    save_figure(figure, path, dpi=110)


def speed(folder, quick: bool) -> None:
    """Times of one problem and of a batch, n = 50, each the fastest of several."""
    rng = np.random.default_rng(SEED + 1)
    count = 1024 if quick else 4096
    rows: list[list[object]] = []
    general = []
    while len(general) < count:
        one = draw(rng)
        if one.family == "general" and one.images == 50 and one.noise > 0:
            general.append(one.data)
    sets = []
    for data in general:
        poses = np.tile(np.eye(4), (50, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = data.rotations, data.translations
        sets.append((poses, data.points))
    batch_in_mm = batch_of(sets, 50)
    for estimate in ESTIMATES:
        pixels = bool({"scale", "common-scale"} & set(estimate))
        problems = replace(batch_in_mm, pixels=pixels)
        answers = jaxcal.calibrate_closed_form(problems, estimate=estimate)
        batch = min(_timed(lambda p=problems, e=estimate: jaxcal.calibrate_closed_form(
            p, estimate=e)) for _ in range(20))  # fmt: skip
        one = problems[0]
        single = min(_timed(lambda p=one, e=estimate: jaxcal.calibrate_closed_form(
            p, estimate=e)) for _ in range(50))  # fmt: skip
        share = float(np.mean(answers.certified))
        rows.append(["+".join(estimate) or "none", count, 1e6 * batch / count, 1e3 * single, share])
    rows.append([machine(), "", "", "", ""])
    header = ("estimate", "problems", "us_a_problem_in_a_batch", "ms_alone", "certified_share")
    write_table(folder / "closed_form_speed.csv", header, rows)
    for row in rows:
        print(*row)


def _timed(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main() -> None:
    quick, folder = arguments(__doc__)
    outcomes: list[Outcome] = []
    total = QUICK if quick else PROBLEMS
    name = "closed_form_quick" if quick else "closed_form"
    kept = Path(__file__).parent / "studies" / name
    kept.mkdir(parents=True, exist_ok=True)
    for index in range(total // BLOCK):
        outcomes += block(index, kept / f"{index}.json")
        print(f"{len(outcomes)} of {total}", flush=True)
    rows = rows_of(outcomes)
    write_table(folder / "closed_form_study.csv", HEADER, rows)
    print(*HEADER)
    for row in rows:
        if row[0] in ("ordinary", "all") and row[1] in ("all", "none"):
            print(*row)
    for o in outcomes:
        if o.above or o.bound_broken or o.false_unique:
            d = o.drawn
            print("look at:", d.family, d.estimate, d.images, d.noise, d.offset, o.objective,
                  o.best, o.gap, o.certified, o.unique)  # fmt: skip
    draw_figure(outcomes, folder / "closed_form_study.png")
    speed(folder, quick)


if __name__ == "__main__":
    main()
