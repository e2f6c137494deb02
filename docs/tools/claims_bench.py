"""Claims of the page on planned poses, and of the certificate."""

from __future__ import annotations

import itertools

import numpy as np
from claims import ACCURACY, PLANNED, claim, column, only, percent, span


# The bench.
def _bench(poses: str, *columns: str) -> list[float]:
    return [only("pose_design_benches", name, poses=poses) for name in columns]


def _bounds() -> list[float]:
    """The least TRE over that of random poses, and how far above it the plans are at most, in %."""
    planned, least = (
        np.array(column("pose_design_bound", f"{name}_over_random"))
        for name in ("planned", "least")
    )
    return [*least, max(100 * (planned / least - 1))]


claim(
    PLANNED,
    "is at least {:.2f}, {:.2f}, {:.2f} and {:.2f} of that of random poses (8, 12, 30 and 60 "
    "images, 40 degrees), and {:.2f}, {:.2f}, {:.2f} and {:.2f} (10 degrees); the plans are "
    "at most {:.1f} % above",
    _bounds,
)


def _foreseen(of: str, *laws: str) -> tuple[float, float]:
    return span(
        column("pose_design_predicted", f"{of}_over_actual", **({"law": laws} if laws else {}))
    )


claim(
    PLANNED,
    "predicts a TRE that is {:.2f} to {:.2f} times the actual one of `auto`, in {:.0f} cells of "
    "{:.0f} recordings: five distributions, planned and random poses, both limits of tilt, {:.0f} "
    "to {:.0f} images",
    lambda: (
        *_foreseen("simulated"),
        len(column("pose_design_predicted", "simulated_over_actual")),
        *set(column("pose_design_predicted", "trials")),
        *span(column("pose_design_predicted", "images")),
    ),
)
claim(
    PLANNED,
    "It is {:.2f} to {:.2f} times the actual TRE for normal, triangular and heavy-tailed offsets, "
    "up to {:.2f} times for uniform ones, whose edges `auto` finds in many images, and {:.2f} to "
    "{:.2f} times for one-sided ones,",
    lambda: (
        *_foreseen("planned", "normal", "triangular", "heavy-tailed"),
        _foreseen("planned", "uniform")[1],
        *_foreseen("planned", "one-sided"),
    ),
)


BOTH = ("tre_mm", "tre_error_mm")
claim(
    PLANNED,
    "TRE {:.3f} +- {:.3f} mm against {:.3f} +- {:.3f}, RP {:.3f} +- {:.3f} mm against {:.3f} +- "
    "{:.3f} (one standard error). 36 of the Sobol plan: {:.3f} mm.",
    lambda: (
        *_bench("optimal 36", *BOTH),
        *_bench("sobol 60", *BOTH),
        *_bench("optimal 36", "rp_mm", "rp_error_mm"),
        *_bench("sobol 60", "rp_mm", "rp_error_mm"),
        *_bench("sobol 36", "tre_mm"),
    ),
)
claim(
    PLANNED,
    "On {:.0f} emulated benches 36 planned poses",
    lambda: _bench("optimal 36", "benches"),
)


def _one_sided() -> tuple[float, float]:
    ratios = column(
        "pose_design",
        "predicted_over_actual",
        law="one-sided",
        method="auto",
        images=("8", "12", "30"),
        poses=("random", "optimal"),
    )
    return span(1 / ratio for ratio in ratios)


claim(
    PLANNED,
    "up to 30 images the actual TRE is {:.1f} to {:.1f} times what `auto` predicts,",
    _one_sided,
)


def _over_five_laws(of: str, cone: str) -> float:
    """The largest over the numbers of images, of the mean over the laws."""
    where = {"cone": cone, "poses": "optimal", "method": "auto"}
    counts = (column("pose_design", of, images=images, **where) for images in ("12", "30", "60"))
    return max(sum(values) / len(values) for values in counts)


claim(
    PLANNED,
    "the mean of the five ratios (planned to random poses) is at most {:.2f} (TRE) and {:.2f} "
    "(RP) with 40 degrees, {:.2f} and {:.2f} with 10 degrees.",
    lambda: [
        _over_five_laws(of, cone)
        for cone in ("wide", "narrow")
        for of in ("tre_over_random", "rp_over_random")
    ],
)


SYMMETRIC = ("uniform", "normal", "heavy-tailed", "triangular")


def _standard_errors(*arms: str) -> tuple[float, float]:
    """Of the table's ratios of root mean squares over the laws, in %."""
    found = []
    for arm, cone, images, of in itertools.product(
        arms, ("wide", "narrow"), ("12", "30", "60"), ("tre", "rp")
    ):
        squared = 0.0
        for poses in (arm, "random"):
            where = {"cone": cone, "images": images, "poses": poses, "method": "auto"}
            means, errors = (
                np.array(column("pose_design", f"{of}_{what}", law=SYMMETRIC, **where))
                for what in ("mm", "error_mm")
            )
            squared += np.sum((means * errors) ** 2) / np.sum(means**2) ** 2
        found.append(100 * squared**0.5)
    return span(found)


claim(
    PLANNED,
    "One standard error is {:.1f} to {:.1f} % (re-planned: {:.1f} to {:.1f} %).",
    lambda: (
        *_standard_errors("sobol", "optimal", "wrong+", "wrong-"),
        *_standard_errors("replanned"),
    ),
)


def _one_side(poses: str) -> tuple[float, float]:
    where = {"law": "one-sided", "method": "auto", "images": ("12", "30", "60")}
    return span(column("pose_design", "tre_over_random", poses=poses, **where))


claim(
    PLANNED,
    "the TRE is {:.2f} to {:.2f} of that of random poses, where one plan reaches {:.2f} to {:.2f};",
    lambda: (*_one_side("replanned"), *_one_side("optimal")),
)


def _filled(of: str, *shares: str, poses: str = "planned") -> list[float]:
    """Of the recordings whose ranges are too long towards the sides."""
    where = {"poses": poses, "curve_mm": "1", "space_filling": shares}
    return list(span(column("plan_faults", of, **where)))


for words, share, form in (
    ("none", "0", "{:.0f} to {:.0f}"),
    ("a tenth", "0.1", "{:.1f} to {:.1f}"),
    ("a fifth (the default)", "0.2", "{:.1f} to {:.1f}"),
):
    claim(
        PLANNED,
        f"| {words} | {{:.0f}} to {{:.0f}} % | {form} % |",
        lambda share=share: percent(
            (*_filled("told_of", share), *_filled("good_and_wrong", share))
        ),
    )
claim(
    PLANNED,
    "In {:.1f} to {:.1f} % of the recordings without an error one is reported.",
    lambda: percent(span(column("plan_faults", "told_of", curve_mm="0"))),
)
claim(
    PLANNED,
    "{:.2f} to {:.2f} mm (TRE, a fifth fills space), at random poses by {:.2f} to {:.2f} mm.",
    lambda: (*_filled("tre_mm", "0.2"), *_filled("tre_mm", "", poses="random")),
)


# The certificate.
def _certified(*images: str) -> float:
    where = {"family": "all", "estimate": "all", "images": images}
    sums = [sum(column("closed_form_study", name, **where)) for name in ("certified", "problems")]
    return 100 * sums[0] / sums[1]


def _none(name: str) -> None:
    if only("closed_form_study", name, family="all", estimate="all", images="4-50"):
        raise ValueError(f"the page says that closed_form_study has none that is {name}")


def _closed_form() -> list[float]:
    _none("above_64_descents")
    _none("false_certificates")
    whole = {"family": "all", "estimate": "all", "images": "4-50"}
    problems = only("closed_form_study", "problems", **whole)
    return [problems, _certified("8"), _certified("12-19", "20-50")]


claim(
    ACCURACY,
    "compares {:,.0f} random problems, degenerate ones among them, with Levenberg-Marquardt from "
    "64 starts. In none of them is the closed form above its best by more than 1e-9, and no "
    "certificate is false. A certificate is found for {:.2f} % of the problems with 8 images and "
    "{:.2f} % of those with 12 or more.",
    _closed_form,
)
