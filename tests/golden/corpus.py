"""The golden corpus: problems with the answers that were recorded for them, and how to compare.

A *family* is one file of problems that share a structure and a number of images, so that each
method is compiled once for all of them. A *call* is one way to ask for an answer, a *road* how: by
``jaxcal.calibrate`` problem by problem (``one``) or by ``jaxcal.calibrate_batch`` (``batch``).
Everything goes through public calls, and inputs and answers are plain numbers in ``.npz`` files.

Differences are in units of the recorded standard deviations (:func:`differences`); what is a
decision (a status, a mean of the offsets or none, an image that stands out) is equal or it flipped.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcal

FOLDER = Path(__file__).parent

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Call:
    """One way to ask for an answer.

    Attributes:
        name: unique within a family.
        arguments: of ``jaxcal.calibrate``; ``options`` as a dictionary.
        roads: which are recorded.
    """

    name: str
    arguments: dict[str, Any]
    roads: tuple[str, ...] = ("one", "batch")

    def keywords(self) -> dict[str, Any]:
        """The arguments as ``jaxcal.calibrate`` takes them."""
        options = self.arguments.get("options")
        return self.arguments | ({"options": jaxcal.Options(**options)} if options else {})


BATCH = ("batch",)
CONVENTIONAL = Call("conventional", {"method": "conventional"})
ALTERNATING = Call("alternating", {"method": "alternating"})
AUTO = Call("auto", {})
UNIFORM = Call("uniform", {"prior": "uniform"})
GAUSSIAN = Call("gaussian", {"prior": "gaussian"})
BOUNDED = Call("bounded", {"prior": "bounded"}, BATCH)
GIVEN = Call("given", {"sigma": [0.3, 0.15, 1.0]})
TRACKER = Call("tracker", {"sigma": [0.3, 0.15, 1.0], "tracker_sd": 0.2}, BATCH)


def of_scale(call: Call) -> Call:
    """The call with the pixels' size unknown; recorded for batches."""
    return Call(call.name, call.arguments | {"estimate": ("scale",)}, BATCH)


CALLS: dict[str, tuple[Call, ...]] = {
    "points12": (
        CONVENTIONAL,
        ALTERNATING,
        AUTO,
        UNIFORM,
        GAUSSIAN,
        BOUNDED,
        GIVEN,
        TRACKER,
        Call(
            "gauss-newton", {"method": "conventional", "options": {"solver": "gauss-newton"}}, BATCH
        ),
        Call("gradient", {"method": "conventional", "options": {"solver": "gradient"}}, BATCH),
        Call("robust gaussian", {"prior": "gaussian", "robust": True}, BATCH),
    ),
    "points24": (
        CONVENTIONAL,
        ALTERNATING,
        AUTO,
        GAUSSIAN,
        BOUNDED,
        GIVEN,
        Call("robust auto", {"robust": True}),
        Call("robust conventional", {"method": "conventional", "robust": True}, BATCH),
    ),
    "points200": (Call("conventional", CONVENTIONAL.arguments, BATCH), AUTO),
    "covariances24": (
        AUTO,
        Call("uniform", UNIFORM.arguments, BATCH),
        Call("gaussian", GAUSSIAN.arguments, BATCH),
        Call("given", GIVEN.arguments, BATCH),
        TRACKER,
    ),
    "bounds24": (
        Call("alternating", ALTERNATING.arguments, BATCH),
        AUTO,
        Call("uniform", UNIFORM.arguments, BATCH),
        BOUNDED,
    ),
    "covariances-bounds12": (AUTO,),
    "pixels24": tuple(map(of_scale, (CONVENTIONAL, ALTERNATING, AUTO, GAUSSIAN, BOUNDED, GIVEN))),
    "pixels-covariances12": tuple(map(of_scale, (AUTO, GAUSSIAN))),
    "linear12": (
        Call("auto, speed and delay", {"estimate": ("sound-speed", "delay")}, BATCH),
        Call("gaussian, speed", {"prior": "gaussian", "estimate": ("sound-speed",)}, BATCH),
        Call("given, channels", {"sigma": [0.3, 1.0], "data": "channels"}, BATCH),
        Call("auto, points", {"data": "points"}, BATCH),
    ),
    "curved12": (
        Call("auto", {}, BATCH),
        Call("gaussian", {"prior": "gaussian"}),
        Call(
            "gaussian, speed and delay",
            {"prior": "gaussian", "estimate": ("sound-speed", "delay")},
            BATCH,
        ),
        Call("conventional", {"method": "conventional"}, BATCH),
    ),
}
"""What is recorded of every family."""

GRADIENTS: tuple[tuple[str, str], ...] = (
    ("points12", "conventional"),
    ("points12", "bounded"),
    ("points12", "given"),
    ("points12", "tracker"),
    ("points12", "gaussian"),
    ("points12", "auto"),
    ("pixels-covariances12", "gaussian"),
    ("curved12", "gaussian, speed and delay"),
)
"""Families and calls whose derivatives are recorded.

Not the alternation: it stops before it is stationary, and says that it is not differentiable.
"""

GRADIENT_PROBLEMS = 4
"""Of each: so many problems."""

LEAST_MM, LEAST_RAD = 1e-3, 1e-5
"""No unknown is taken to be known better than this: a micrometre, also at the end of 100 mm."""


@dataclass(frozen=True)
class Family:
    """Problems of one structure.

    Attributes:
        name: of the family.
        kinds: what is special about each problem, in a word.
        arrays: the inputs (leading axis: problems), by name.
        pixels: measurements are pixels without a known spacing.
        probe: of the times of flight: kind, elements, pitch_mm, radius_mm; None for points.
    """

    name: str
    kinds: list[str]
    arrays: Arrays
    pixels: bool = False
    probe: dict[str, Any] | None = None
    written: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.kinds)

    def usable(self) -> np.ndarray:
        """Which problems ``jaxcal.calibrate`` does not refuse: finite, with four used images."""
        mask = self.arrays["mask"] > 0
        finite = np.ones(len(self), bool)
        if self.probe is None:
            for name in ("poses", "measurements"):
                values = self.arrays[name].reshape(*mask.shape, -1)
                finite &= (np.isfinite(values).all(axis=2) | ~mask).all(axis=1)
        return finite & (mask.sum(axis=1) >= 4)

    def call(self, name: str) -> Call:
        """One of the family's calls."""
        return next(call for call in CALLS[self.name] if call.name == name)

    def problems(self, rows: np.ndarray | None = None) -> jaxcal.Problem:
        """The problems (or some of them) as a batch, in float64."""
        rows = np.arange(len(self)) if rows is None else rows
        with jax.enable_x64(True):
            if self.probe is not None:
                return jaxcal.stack([self._from_times(row) for row in rows])
            return self._from_points(rows)

    def _from_points(self, rows: np.ndarray) -> jaxcal.Problem:
        """Arrays as they are: some hold NaN, or too few images, which a constructor refuses."""
        arrays = {name: values[rows] for name, values in self.arrays.items()}
        images = arrays["mask"].shape[1]
        poses = np.tile(np.eye(4), (len(rows), images, 1, 1))
        poses[:, :, :3] = arrays["poses"]
        harmless = np.random.default_rng(0).uniform(20, 60, (images, 2))
        away = np.tile(np.eye(4), (images, 1, 1))
        away[:, :3, 3] = 10 * harmless[:, :1]
        template = jaxcal.Problem.from_recording(
            jaxcal.make_images(
                away,
                harmless,
                "pixel" if self.pixels else "point",
                covariance=np.tile(np.eye(2), (images, 1, 1)) if "covariance" in arrays else None,
                max_elevation=1.0 if "max_elevation" in arrays else None,
            )
        )
        changed = {"poses": poses}
        changed |= {
            name: arrays[name]
            for name in ("measurements", "mask", "max_elevation")
            if name in arrays
        }
        if "covariance" in arrays:
            xx, xy, yy = np.moveaxis(arrays["covariance"], -1, 0)
            changed["covariance"] = np.stack([xx, xy, xy, yy], -1).reshape(*xx.shape, 2, 2)
        batch = jaxcal.stack([template] * len(rows))
        return replace(
            batch, **{name: jnp.asarray(value, jnp.float64) for name, value in changed.items()}
        )

    def _from_times(self, row: int) -> jaxcal.Problem:
        assert self.probe is not None
        kind, numbers = self.probe["kind"], {k: v for k, v in self.probe.items() if k != "kind"}
        probe = (jaxcal.CurvilinearProbe if kind == "curvilinear" else jaxcal.LinearProbe)(
            **numbers
        )
        images = jaxcal.make_images(
            self.arrays["poses"][row],
            self.arrays["times"][row],
            "time_of_flight",
            mask=self.arrays["mask"][row] > 0,
        )
        return jaxcal.Problem.from_recording(jaxcal.Recording(images, probe=probe))


def load(name: str) -> tuple[Family, dict[tuple[str, str], Arrays]]:
    """A family and its recorded answers, by call and road."""
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as stored:
        arrays = {key: stored[key] for key in stored.files}
    about = json.loads(str(arrays.pop("about")))
    family = Family(
        name,
        [str(kind) for kind in arrays.pop("kinds")],
        {key.split("/")[1]: value for key, value in arrays.items() if key.startswith("input/")},
        about["pixels"],
        about["probe"],
        about["written"],
    )
    answers: dict[tuple[str, str], Arrays] = {}
    for key, value in arrays.items():
        if not key.startswith("input/"):
            call, road, field_name = key.split("/")
            answers.setdefault((call, road), {})[field_name] = value
    return family, answers


def save(family: Family, answers: dict[tuple[str, str], Arrays]) -> None:
    """Write a family with its answers."""
    about = {"pixels": family.pixels, "probe": family.probe, "written": family.written}
    arrays: Arrays = {"about": np.array(json.dumps(about)), "kinds": np.array(family.kinds)}
    arrays |= {f"input/{name}": value for name, value in family.arrays.items()}
    for (call, road), fields in answers.items():
        arrays |= {f"{call}/{road}/{name}": value for name, value in fields.items()}
    np.savez_compressed(FOLDER / f"{family.name}.npz", **arrays)  # pyright: ignore[reportArgumentType]


UPPER6, UPPER3 = np.triu_indices(6), np.triu_indices(3)

DECISIONS = (
    "status_code",
    "tolerance_met",
    "searched_start",
    "sigma_tuned",
    "differentiable",
    "outlier",
    "at_bound",
    "weighed",
)
"""Fields that are equal or not."""

PROBABILITIES = ("probability", "mean_probability", "trust", "own_probability")
"""Of the offsets' law; compared as they are."""


def numbers(result: jaxcal.Calibration) -> Arrays:
    """What is recorded of an answer (or of a batch of them)."""

    def get(name: str) -> np.ndarray:
        parts = (result, result.convergence, result.medium)
        return np.asarray(next(getattr(part, name) for part in parts if hasattr(part, name)))

    found = {
        "image_to_probe": get("image_to_probe")[..., :3, :],
        "covariance": get("covariance")[(..., *UPPER6)],
        "point_covariance": get("point_covariance")[(..., *UPPER3)],
        "status_code": get("status_code").astype(np.int8),
        "iterations": get("iterations").astype(np.int32),
    }
    for name in (
        "point",
        "elevation",
        "elevation_sd",
        "sigma",
        "rms",
        "cost",
        "condition",
        "weakest_sd",
    ):
        found[name] = get(name)
    for name in (
        "tolerance_met",
        "searched_start",
        "sigma_tuned",
        "differentiable",
        "outlier",
        "at_bound",
    ):
        found[name] = get(name).astype(bool)
    for part, names in (
        (result, ("scale_mm_per_px", "channel_sigma")),
        (result.medium, ("sound_speed_m_s", "sound_speed_sd_m_s", "delay_s", "delay_sd_s")),
    ):
        for name in names:
            if getattr(part, name) is not None:
                found[name] = get(name)
    law = result.offset_law
    if law is not None:
        for name in ("mean", "mean_sd", *PROBABILITIES):
            found[name] = np.asarray(getattr(law, name))
        found["weighed"] = np.asarray(law.weighed).astype(bool)
    return found


def compute(family: Family, call: Call, road: str, rows: np.ndarray | None = None) -> Arrays:
    """Answers through the public calls; of road ``one``, NaN and status -1 where it refuses."""
    rows = np.arange(len(family)) if rows is None else np.asarray(rows)
    problems, keywords = family.problems(rows), call.keywords()
    with jax.enable_x64(True):
        if road == "batch":
            return numbers(jaxcal.calibrate_batch(problems, **keywords).numpy())
        each: list[Arrays | None] = []
        for place, row in enumerate(rows):
            # Images of a single pose are refused, one problem at a time.
            if not family.usable()[row] or family.kinds[row] == "one pose":
                each.append(None)
                continue
            problem = jax.tree.map(lambda leaf, k=place: np.asarray(np.asarray(leaf)[k]), problems)
            each.append(numbers(jaxcal.calibrate(problem, **keywords).numpy()))
    pattern = next(answer for answer in each if answer is not None)

    def refused(name: str, like: np.ndarray) -> np.ndarray:
        if name == "status_code":
            return np.full_like(like, -1)
        return np.full_like(like, np.nan if like.dtype.kind == "f" else 0)

    return {
        name: np.stack([refused(name, like) if one is None else one[name] for one in each])
        for name, like in pattern.items()
    }


def at(answers: Arrays, rows: np.ndarray) -> Arrays:
    """The answers of some problems."""
    return {name: value[rows] for name, value in answers.items()}


def converged(recorded: Arrays, found: Arrays) -> np.ndarray:
    """Which problems have an answer in both: one that converged and is observable."""
    return (recorded["status_code"] == 0) & (found["status_code"] == 0)


def flips(recorded: Arrays, found: Arrays) -> dict[str, np.ndarray]:
    """Decisions that differ: by field, which problems.

    Of problems without an answer only the status counts: what else is said of a place where the
    data determine nothing is rounding.
    """
    result = {}
    answered = converged(recorded, found)
    for name in DECISIONS:
        if name in recorded:
            differs = recorded[name] != found[name]
            differs = differs.reshape(len(differs), -1).any(axis=1)
            if name != "status_code":
                differs &= answered
            if name == "differentiable":
                differs &= ~on_absolute_floor(recorded)
            if differs.any():
                result[name] = np.flatnonzero(differs)
    return result


def on_absolute_floor(recorded: Arrays) -> np.ndarray:
    """Problems of exact data, whose tuned SDs all rest on their floor of 1e-6 mm.

    The code of that day overlooked this floor and called them differentiable.
    """
    return (np.nan_to_num(recorded["sigma"], nan=np.inf) <= 1.001e-6).all(axis=-1)


def differences(recorded: Arrays, found: Arrays) -> Arrays:
    """How far apart answers are, problem by problem.

    In units of the recorded SDs: ``X`` (the largest of the six of X Exp(d)), ``point``,
    ``elevation``, ``sigma`` (of which the SD is taken to be sigma / sqrt(2 n)), ``scale``,
    ``sound_speed``, ``delay``, ``mean``. ``covariance`` and ``point_covariance``: the largest
    |difference| over the product of the two SDs. Probabilities: absolute. ``cost``, ``rms``,
    ``condition``: relative. NaN for problems that have no answer in either (:func:`converged`) or
    one without a covariance, which nothing but a bound confines, or where distributions were not
    weighed; infinite where only one has a covariance.
    """
    # Infinities and NaN of what has no answer go out at the end.
    with np.errstate(invalid="ignore"):
        return _differences(recorded, found)


def _differences(recorded: Arrays, found: Arrays) -> Arrays:
    count = len(recorded["status_code"])
    covariance = np.zeros((count, 6, 6))
    covariance[:, UPPER6[0], UPPER6[1]] = recorded["covariance"]
    sd = np.sqrt(np.einsum("kii->ki", covariance))
    known = np.isfinite(sd).all(axis=1)
    unit = np.maximum(np.where(np.isfinite(sd), sd, np.inf), np.repeat([LEAST_MM, LEAST_RAD], 3))
    point = np.zeros((count, 3, 3))
    point[:, UPPER3[0], UPPER3[1]] = recorded["point_covariance"]
    point_unit = np.maximum(np.sqrt(np.einsum("kii->ki", point)), LEAST_MM)
    images = recorded["elevation"].shape[1]
    tuned_unit = np.maximum(recorded["sigma"], LEAST_MM)
    own = np.where(
        np.isfinite(recorded["elevation_sd"]), recorded["elevation_sd"], tuned_unit[:, 2:]
    )
    own = np.maximum(own, LEAST_MM)

    def largest(values: np.ndarray) -> np.ndarray:
        values = np.abs(values).reshape(count, -1)
        return values.max(axis=1) if values.shape[1] else np.zeros(count)

    def apart(name: str) -> np.ndarray:
        return found[name] - recorded[name]

    x, y = recorded["image_to_probe"], found["image_to_probe"]
    moved = np.einsum("kji,kj->ki", x[:, :, :3], y[:, :, 3] - x[:, :, 3])
    relative = np.einsum("kji,kjl->kil", x[:, :, :3], y[:, :, :3])
    skew = 0.5 * (relative - np.swapaxes(relative, 1, 2))
    turned = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    result = {
        "X": largest(np.concatenate([moved, turned], axis=1) / unit),
        "point": largest(apart("point") / point_unit),
        "elevation": largest(apart("elevation") / own),
        "sigma": largest(apart("sigma") / tuned_unit * np.sqrt(2 * images)),
        "covariance": largest(apart("covariance") / (unit[:, UPPER6[0]] * unit[:, UPPER6[1]])),
        "point_covariance": largest(
            apart("point_covariance") / (point_unit[:, UPPER3[0]] * point_unit[:, UPPER3[1]])
        ),
        "elevation_sd": np.nan_to_num(np.abs(apart("elevation_sd")) / own).max(axis=1),
    }
    for name in ("cost", "rms", "condition"):
        floor = LEAST_MM**2 if name == "cost" else LEAST_MM
        result[name] = np.abs(apart(name)) / np.maximum(np.abs(recorded[name]), floor)
    if "scale_mm_per_px" in recorded:
        # No SD of the scale is recorded: what it moves at a depth of 100 mm, in SDs of X.
        off = 100.0 * apart("scale_mm_per_px") / recorded["scale_mm_per_px"]
        result["scale"] = largest(off) / unit[:, :3].min(axis=1)
    for name in ("sound_speed", "delay"):
        key = f"{name}_m_s" if name == "sound_speed" else f"{name}_s"
        sd_key = f"{name}_sd_m_s" if name == "sound_speed" else f"{name}_sd_s"
        if key in recorded:
            result[name] = np.abs(apart(key)) / recorded[sd_key]
            result[f"{name}_sd"] = np.abs(apart(sd_key)) / recorded[sd_key]
    if "channel_sigma" in recorded:
        relative = np.abs(apart("channel_sigma")) / recorded["channel_sigma"]
        result["channel_sigma"] = relative * np.sqrt(2 * images)
    if "probability" in recorded:
        weighed = recorded["weighed"] & found["weighed"]
        mean_sd = np.where(weighed, np.maximum(recorded["mean_sd"], LEAST_MM), 1.0)
        for name in ("mean", "mean_sd"):
            result[name] = np.where(weighed, np.abs(apart(name)) / mean_sd, np.nan)
        for name in PROBABILITIES:
            result[name] = np.where(weighed, largest(apart(name)), np.nan)
    answered = converged(recorded, found)
    same_kind = np.isfinite(found["covariance"]).all(axis=1) == known
    for name in result:
        result[name] = np.where(same_kind, result[name], np.inf)
        result[name] = np.where(answered & (known | ~same_kind), result[name], np.nan)
    return result


def gradient_arrays(family: Family, call: Call, rows: np.ndarray, weight: np.ndarray) -> Arrays:
    """One scalar of the answer, with its derivatives by measurements and poses, of some problems.

    The scalar is the sum of ``weight`` times X (12 numbers), the target (3) and the offsets. Times
    of flight enter by their distances, which are what a problem holds of them.
    """
    problems, keywords = family.problems(rows), call.keywords()
    channels = family.probe is not None

    def value(measured: jax.Array, poses: jax.Array, problem: jaxcal.Problem) -> jax.Array:
        moved = replace(problem, poses=poses)
        if channels:
            assert problem.channels is not None
            moved = replace(moved, channels=replace(problem.channels, distances=measured))
        else:
            moved = replace(moved, measurements=measured)
        result = jaxcal.calibrate(moved, **keywords)
        count = result.elevation.shape[0]
        return (
            jnp.sum(weight[:12] * result.image_to_probe[:3].ravel())
            + weight[12:15] @ result.point
            + weight[15 : 15 + count] @ result.elevation
        )

    with jax.enable_x64(True):
        measured = problems.channels.distances if channels else problems.measurements
        program = jax.jit(jax.vmap(jax.value_and_grad(value, argnums=(0, 1))))
        scalar, (by_measured, by_poses) = program(measured, problems.poses, problems)
    return {
        "rows": rows,
        "weight": weight,
        "value": np.asarray(scalar),
        "by_measurements": np.asarray(by_measured),
        "by_poses": np.asarray(by_poses)[:, :, :3],
    }


def recorded_gradients() -> dict[str, Arrays]:
    """The recorded derivatives, by ``family/call``."""
    path, found = FOLDER / "gradients.npz", {}
    if path.exists():
        with np.load(path, allow_pickle=False) as stored:
            for key in stored.files:
                if "/" in key:
                    which, _, name = key.rpartition("/")
                    found.setdefault(which, {})[name] = stored[key]
    return found


def gradient_differences(recorded: Arrays, found: Arrays) -> Arrays:
    """Relative to the largest derivative of a problem's own kind, problem by problem."""
    result = {}
    for name in ("by_measurements", "by_poses"):
        reference = recorded[name].reshape(len(recorded[name]), -1)
        difference = found[name].reshape(reference.shape) - reference
        # Derivatives by positions and by entries of rotations differ in size, so each by its own.
        if name == "by_poses":
            shape = recorded[name].shape
            for part, columns in (("by_rotations", slice(0, 3)), ("by_positions", slice(3, 4))):
                size = recorded[name][..., columns].reshape(shape[0], -1)
                off = difference.reshape(shape)[..., columns].reshape(shape[0], -1)
                result[part] = np.abs(off).max(axis=1) / np.abs(size).max(axis=1)
        else:
            result[name] = np.abs(difference).max(axis=1) / np.abs(reference).max(axis=1)
    result["value"] = np.abs(found["value"] - recorded["value"]) / np.abs(recorded["value"])
    return result


TIGHT = 1e-8
"""What answers may differ by, in SDs, where nothing is said below."""

LOOSER: tuple[tuple[str, str, str, float], ...] = (
    # Least squares stops at a cosine of 1e-10 between residuals and Jacobian, which along a
    # direction that the images hardly see is some 1e-8 SDs.
    ("*", "conventional", "X point elevation", 5e-8),
    ("*", "conventional", "sigma", 3e-7),
    ("*", "gauss-newton", "X point elevation", 1e-6),
    ("*", "gauss-newton", "sigma", 1e-6),
    ("*", "given", "X point", 2e-8),
    # It starts where the conventional fit stopped, and stops before it is stationary.
    ("*", "alternating", "X point elevation sigma", 3e-7),
    ("*", "alternating", "covariance point_covariance condition", 5e-8),
    # Self-tuning stops where no SD changes by 1e-9.
    ("*", "auto uniform gaussian", "X point elevation", 3e-8),
    ("*", "auto uniform gaussian", "covariance", 3e-8),
    ("*", "auto uniform gaussian", "cost", 3e-7),
    # Where poses span a narrow cone, the condition (1e5) follows the place where a solve stopped:
    # by this much between one and the same code on two machines.
    ("points24", "conventional", "condition", 3e-7),
    ("points24", "auto gaussian", "condition", 3e-8),
    # An evidence is stationary in nothing: what it is made of differs by 1e-9 and is multiplied by
    # squared residuals in SDs. On images whose offsets rest on their floor it may be anything.
    ("*", "auto uniform", "log_odds", 1e-5),
    ("covariances24", "auto", "sigma covariance condition probability mean_sd", 1e-7),
    ("covariances24", "auto", "elevation_sd", 1e-7),
    ("bounds24", "auto", "probability", 1e-7),
    ("covariances-bounds12", "auto", "*", 1e-5),
)
"""File, calls, numbers, and what is allowed: what today's two roads differ by, measured."""


def tolerance(family: str, call: str, number: str) -> float:
    """What a difference may be, in the units of :func:`differences`."""
    allowed = TIGHT
    for file, calls, names, value in LOOSER:
        of_call = any(call == one or call == f"robust {one}" for one in calls.split())
        if file in ("*", family) and of_call and (names == "*" or number in names.split()):
            allowed = max(allowed, value)
    return allowed


FLAT = "rounding: the objective is flat there"
INTERVAL = "the minimisers form an interval: another point of it, at the same cost"
ANOTHER = "another local minimum"
EARLY = "the recorded answer had stopped too early"
CONVERGES = "it converges, where max_iterations is recorded"
LOST = "max_iterations, where it had converged; the images do not determine X"
UNSEARCHED = "its start is no longer searched for; the images do not determine X"

DIFFERENT: tuple[tuple[str, str, str, str, tuple[int, ...]], ...] = (
    ("points12", "bounded", "batch", ANOTHER, (3,)),
    (
        "points12",
        "bounded",
        "batch",
        FLAT,
        (
            16,
            20,
            46,
            60,
        ),
    ),
    (
        "points12",
        "bounded",
        "batch",
        INTERVAL,
        (
            22,
            24,
        ),
    ),
    (
        "points12",
        "bounded",
        "batch",
        LOST,
        (
            40,
            50,
        ),
    ),
    ("points12", "given", "batch", ANOTHER, (42,)),
    (
        "points12",
        "tracker",
        "batch",
        FLAT,
        (
            16,
            44,
            52,
            62,
        ),
    ),
    ("points12", "tracker", "batch", ANOTHER, (42,)),
    ("points12", "tracker", "batch", CONVERGES, (54,)),
    (
        "points12",
        "gradient",
        "batch",
        FLAT,
        (
            0,
            1,
            5,
            11,
            13,
            17,
            21,
            23,
            29,
            33,
            34,
            35,
            42,
            45,
            51,
            55,
            61,
            62,
        ),
    ),
    ("points24", "bounded", "batch", INTERVAL, (22,)),
    (
        "points24",
        "bounded",
        "batch",
        FLAT,
        (
            28,
            34,
        ),
    ),
    (
        "covariances24",
        "gaussian",
        "batch",
        EARLY,
        (
            6,
            16,
            26,
            36,
        ),
    ),
    ("covariances24", "gaussian", "batch", FLAT, (14,)),
    (
        "covariances24",
        "gaussian",
        "batch",
        CONVERGES,
        (
            23,
            32,
        ),
    ),
    ("covariances24", "given", "batch", FLAT, (3,)),
    ("covariances24", "given", "batch", ANOTHER, (29,)),
    (
        "bounds24",
        "bounded",
        "batch",
        FLAT,
        (
            12,
            19,
            22,
            24,
            38,
        ),
    ),
    ("pixels24", "alternating", "batch", FLAT, (21,)),
    (
        "pixels24",
        "gaussian",
        "batch",
        EARLY,
        (
            6,
            18,
        ),
    ),
    ("pixels24", "gaussian", "batch", FLAT, (19,)),
    ("pixels24", "bounded", "batch", INTERVAL, (7,)),
    ("pixels24", "bounded", "batch", FLAT, (21,)),
    ("pixels24", "given", "batch", FLAT, (9,)),
    ("linear12", "gaussian, speed", "batch", FLAT, (2,)),
    ("linear12", "given, channels", "batch", FLAT, (9,)),
    ("curved12", "gaussian", "batch", CONVERGES, (8,)),
    ("curved12", "gaussian, speed and delay", "batch", FLAT, (13,)),
    ("points12", "alternating", "one", UNSEARCHED, (50,)),
    ("points12", "given", "one", LOST, (60,)),
    (
        "points24",
        "alternating",
        "one",
        UNSEARCHED,
        (
            40,
            50,
            60,
        ),
    ),
    ("points24", "given", "one", LOST, (50,)),
    ("curved12", "gaussian", "one", CONVERGES, (8,)),
)
"""File, call, road, why, and the problems whose answer is known to be another one than recorded.

They were looked at one by one (README.md). ``check.py`` names them, and of their numbers looks only
at the cost, and at rounding with :data:`FLAT_ALLOWANCE`.
"""

FLAT_ALLOWANCE = 3e-3
"""What rounding may move there, in SDs: one offset by 2.3e-3, all else by 6e-5."""

COST_ALLOWANCE = 5e-3
"""By how much of itself the cost of a problem that is known to differ may be higher."""


def known_to_differ(family: str, call: str, road: str) -> dict[int, str]:
    """Why, for each problem of this file that is known to differ."""
    return {
        row: why for *which, why, rows in DIFFERENT if which == [family, call, road] for row in rows
    }


GRADIENT_TOLERANCE = 1e-6
"""Relative, see :func:`gradient_differences`."""

SELF_TUNED = ("auto", "uniform", "gaussian", "robust auto", "robust gaussian")


def stopped_early(family: Family, call: str, road: str) -> np.ndarray:
    """Problems whose recorded answer is not at its minimum, by a fault of the code of that day.

    With fewer than eight used images self-tuning holds its SDs, and ``calibrate`` then stopped at a
    cosine of 1e-3 (``calibrate_batch`` at 1e-10): X was up to 3e-3 SDs off, ``differentiable``
    false. Their numbers are not compared on that road; those of the batch are.
    """
    used = (family.arrays["mask"] > 0).sum(axis=1)
    if road != "one" or call not in SELF_TUNED or family.probe is not None:
        return np.zeros(len(family), bool)
    return used < 8
