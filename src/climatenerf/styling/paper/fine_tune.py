"""The fit of the appearance grid alone to what teachers show. Everything else stays bit by bit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import integers
from climatenerf.core.errors import UserError
from climatenerf.field.hash_field import Field
from climatenerf.styling.paper.shots import Rays, matter
from climatenerf.training.losses import colour_error
from climatenerf.training.optimiser import GridAdam

RAYS = 4096  # of a step
FIRST_RATE, LAST_RATE = 1e-2, 5e-4  # learning rates, with an exponential decay between
INTERVAL = 25  # steps between two measurements, and two checkpoints
MEASURED = 16_384  # the most rays of a measurement
PATIENCE = 4  # measurements without a gain on other views, after which the fit ends
MIN_GAIN = 0.02  # dB


@dataclass(frozen=True)
class Lesson:
    """Rays, and the display colour that each is to have.

    Attributes:
        rays: the rays.
        target: sRGB, continued linearly above 1.
    """

    rays: Rays
    target: Float[Tensor, "n 3"]

    def none(self) -> "Lesson":
        """Return a lesson without rays."""
        rows = torch.zeros(0, dtype=torch.long, device=self.target.device)
        return Lesson(self.rays.rows(rows), self.target[rows])


@dataclass(frozen=True)
class Score:
    """How near the field is to its teacher.

    Attributes:
        step: steps taken.
        taught: PSNR of the views that teach, dB.
        others: PSNR of views that do not teach, dB; NaN without such views.
    """

    step: int
    taught: float
    others: float


def learning_rate(step: int, steps: int) -> float:
    """Return the learning rate of a step, the first being 0."""
    return FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (step / steps)


def psnr(field: Field, lesson: Lesson) -> float:
    """Return the PSNR (dB) of display colours over at most `MEASURED` rays; NaN without rays."""
    count = len(lesson.rays)
    if not count:
        return float("nan")
    every = torch.arange(0, count, -(-count // MEASURED), device=lesson.target.device)
    with torch.no_grad():
        error = _error(field, lesson, every).mean()
    return -10 * float(np.log10(max(float(error), 1e-10)))  # an exact match: log 0


def _error(field: Field, lesson: Lesson, index: Tensor) -> Float[Tensor, "m"]:
    rays = lesson.rays.rows(index)
    return colour_error(matter(field, rays) + rays.behind, lesson.target[index])


class FineTuning:
    """A fit of the appearance grid: the field, its optimiser, and what was measured."""

    def __init__(self, field: Field, steps: int, seed: int):
        """Begin at step 0.

        Args:
            field: whose appearance grid changes; its surface head must not read it.
            steps: of the whole fit.
            seed: of the rays that are drawn.
        """
        assert field.size.surface_levels, "the surface head reads the appearance grid"
        field.requires_grad_(False)
        field.appearance_grid.requires_grad_(True)
        self.field, self.steps, self.seed = field, steps, seed
        self.adam = GridAdam([field.appearance_grid])
        self.scores: list[Score] = []

    @property
    def step(self) -> int:
        """Steps taken."""
        return self.adam.steps

    @property
    def finished(self) -> bool:
        """Whether all steps are taken, or other views have stopped improving."""
        return self.step >= self.steps or exhausted([score.others for score in self.scores])

    def run(self, lesson: Lesson, others: Lesson, after: Callable[["FineTuning"], None]) -> None:
        """Step until the end.

        Args:
            lesson: what teaches.
            others: what is measured only.
            after: called after each step.

        Raises:
            UserError: colours became not finite.
        """
        if not self.scores:
            self._measure(lesson, others)
        while not self.finished:
            self._learn(lesson)
            if self.step % INTERVAL == 0 or self.step == self.steps:
                self._measure(lesson, others)
            after(self)

    def _learn(self, lesson: Lesson) -> None:
        """Take one step. Its rays depend on seed and step alone, as a resumed fit needs."""
        drawn = (self.seed * 1_000_003 + self.step) % 2**63
        generator = torch.Generator(device="cpu").manual_seed(drawn)
        count, device = len(lesson.rays), lesson.target.device
        index = integers(generator, 0, count, RAYS, device=device)
        loss = _error(self.field, lesson, index).mean()
        if not bool(loss.isfinite()):
            raise UserError(f"the colours became not finite at step {self.step}; give other photos")
        loss.backward()
        self.adam.step(learning_rate(self.step, self.steps))

    def _measure(self, lesson: Lesson, others: Lesson) -> None:
        taught, rest = psnr(self.field, lesson), psnr(self.field, others)
        self.scores.append(Score(self.step, taught, rest))

    def state(self) -> dict[str, Tensor]:
        """Return the tensors with which `load` continues the fit."""
        rows = [[score.step, score.taught, score.others] for score in self.scores]
        scores = torch.tensor(rows, dtype=torch.float64, device="cpu").reshape(-1, 3)
        grid = self.field.appearance_grid.detach()
        return {"grid": grid, "scores": scores} | self.adam.state()

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from the tensors of `state`."""
        with torch.no_grad():
            self.field.appearance_grid.copy_(state["grid"])
        self.adam.load(state)
        rows = state["scores"].tolist()
        self.scores = [Score(int(step), taught, others) for step, taught, others in rows]


def exhausted(scores: list[float]) -> bool:
    """Return whether the last `PATIENCE` measurements are no better than one before them.

    Without other views (NaN) it never is.
    """
    if len(scores) <= PATIENCE:
        return False
    return max(scores[-PATIENCE:]) < max(scores[:-PATIENCE]) + MIN_GAIN


def lesson_of(rays: Rays, matter_target: Float[Tensor, "n 3"]) -> Lesson:
    """Return the lesson of rays whose matter is to have a linear radiance; rays of sky are left."""
    rows = rays.opaque()
    kept = rays.rows(rows)
    return Lesson(kept, encode_srgb(matter_target[rows] + kept.behind))
