"""``climatenerf study make|score``: the page of a user study, and the scores of its votes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_seed

if TYPE_CHECKING:
    from climatenerf.studies.user_study.design import Study as Pairs
    from climatenerf.studies.user_study.scores import Scores, Share

PARTICIPANTS = 37  # of the paper
SHARES = (0.55, 0.6, 0.65, 0.7, 0.75)
SCORES = "scores.json"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Make:
    """Make the page of a study from comparisons: index.html for participants, and key.json."""

    folders: tyro.conf.Positional[Annotated[tuple[Path, ...], optional("COMPARE_FOLDER...")]]
    """Folders from `climatenerf compare`, one for each scene."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder to write into."""
    votes: int = 72
    """Pairs that each participant judges, at most. Three hidden repeats and two catch pairs are
    added."""
    without: tuple[str, ...] = ()
    """Methods to leave out, such as frame-noise."""
    seed: int = 0
    """Changes ids, order and sides."""


@dataclass(frozen=True)
class Score:
    """Score the votes of a study: a table, and scores.json with -o."""

    votes: tyro.conf.Positional[Annotated[tuple[Path, ...], optional("VOTES.csv...")]]
    """CSV files that the page saved."""
    key: Annotated[Path | None, optional("PATH")] = None
    """The study's key.json. Default: that beside the first file of votes."""
    out: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH", help_behavior_hint="")
    ] = None
    """Folder for scores.json."""
    seed: int = 0
    """Random seed of the bootstrap."""


@dataclass(frozen=True)
class Study:
    """Compare methods by a user study: make its page, and score its votes."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Make, tyro.conf.subcommand("make")]
        | Annotated[Score, tyro.conf.subcommand("score")]
    ]


def run(options: Study) -> int:
    """Make or score a study."""
    check_seed(options.action.seed)
    if isinstance(options.action, Make):
        return run_make(options.action)
    return run_score(options.action)


def run_make(options: Make) -> int:
    """Write the page and the key; print where they are and what the size of the study can show."""
    from climatenerf.studies.user_study.compare_folder import read_compare_folder
    from climatenerf.studies.user_study.design import plan_study
    from climatenerf.studies.user_study.page import KEY, PAGE, write_study

    folders = [read_compare_folder(folder) for folder in options.folders]
    study = plan_study(folders, options.seed, options.votes, options.without)
    with progress.Bar("study", 1.0) as bar:
        written = write_study(study, options.out, lambda done, total: bar.update(done / total))
    if study.alone:
        progress.warn(
            f"{study.alone} pictures or movies have no counterpart of the same effect and view, and"
            " are left out"
        )
    if written.unequal:
        progress.warn(
            f"the sides of {written.unequal} pairs differ in size, which participants may notice"
        )
    for scene in study.sources()[1]:
        progress.warn(
            f"the licence line of {scene} names a method, so the page does not show it; give it to"
            " the participants after the study"
        )
    progress.result(f"page for participants: {options.out / PAGE}")
    if not written.inline:
        progress.result(f"  with its media beside it in {options.out / 'media'}")
    progress.result(f"key, for you alone: {options.out / KEY}")
    progress.result(f"\nstudy {written.id}: {size_text(study)}")
    return 0


def size_text(study: "Pairs") -> str:
    """Return how large a study is, and what that can show."""
    from climatenerf.studies.user_study.design import CATCHES, REPEATS
    from climatenerf.studies.user_study.preference import share_shown, votes_needed

    counts = study.votes_by_comparison()
    fewest = min(counts.values())
    lines = [
        f"{len(study.pairs)} pairs in {len(counts)} comparisons of effect, kind and method.",
        f"Each participant judges {study.votes} pairs, up to {REPEATS} of them twice, and"
        f" {CATCHES} catch pairs.",
        f"Votes of a participant for each comparison, on average: {fewest:.3g} or more.",
        "",
        "Votes that show a share for ours with 80 % power (two-sided binomial test, 5 %), and the",
        f"participants for them; the last column holds for the strictest of {len(counts)} tests.",
        "",
    ]
    rows: list[tuple[str, ...]] = [("share", "votes", "participants", "with Holm")]
    for share in SHARES:
        needed = [votes_needed(share), votes_needed(share, 0.05 / len(counts))]
        people = ["-" if each is None else str(-int(-each // fewest)) for each in needed]
        rows.append((f"{share:.0%}", str(needed[0]), *people))
    lines += aligned(rows)
    shown = share_shown(PARTICIPANTS * fewest)
    least = "no share" if shown is None else f"a share of {shown:.0%} or more"
    lines += ["", f"{PARTICIPANTS} participants, as in the paper, can show {least}."]
    return "\n".join(lines)


def run_score(options: Score) -> int:
    """Print the scores, and write them as JSON with -o."""
    from climatenerf.studies.user_study.page import KEY
    from climatenerf.studies.user_study.scores import score
    from climatenerf.studies.user_study.votes import read_key, read_votes

    if not options.votes:
        raise UserError("no votes are given; give the CSV files that the page saved")
    path = options.votes[0].parent / KEY if options.key is None else options.key
    if options.key is None and not path.exists():
        raise UserError(f"{path} does not exist; give the study's key with --key OUT/{KEY}")
    key = read_key(path)
    scores = score(read_votes(options.votes, key), key, options.seed)
    if options.out is not None:
        write_scores(scores, options.out)
    progress.result(table(scores))
    if options.out is not None:
        progress.result(f"\nscores: {options.out / SCORES}")
    return 0


def write_scores(scores: "Scores", out: Path) -> None:
    """Write scores.json.

    Raises:
        UserError: a file of this name holds something else, or cannot be written.
    """
    import climatenerf
    from climatenerf.core.locks import only_writer
    from climatenerf.core.storage import plain, read_json, write_json

    with only_writer(out):
        file = out / SCORES
        if file.exists() and "comparisons" not in read_json(file, "scores"):
            raise UserError(f"{file} holds no scores of a study; choose another folder with -o")
        about = {"schema_version": SCHEMA_VERSION, "climatenerf": climatenerf.__version__}
        write_json(file, about | plain(scores))


def table(scores: "Scores") -> str:
    """Return the scores as aligned lines."""
    intervals = ("95 % by votes", "by participants")
    heads = ("effect", "kind", "against", "votes", "for ours", *intervals, "p", "Holm")
    rows: list[tuple[str, ...]] = [heads]
    for each in scores.comparisons:
        ours, people = each.ours, each.interval_of_participants
        name = (each.effect, each.kind, each.other, str(ours.votes))
        if not ours.votes:
            rows.append((*name, "-", "-", "-", "-", "-"))
            continue
        shares = (percent(ours.share), span(ours.interval), "-" if people is None else span(people))
        rows.append((*name, *shares, p_text(each.p), p_text(each.p_holm)))
    lines = aligned(rows)
    lines += [
        "",
        *aligned([("effect", "kind", "method", "log-strength", "95 %"), *_strengths(scores)]),
    ]
    excluded = f" ({', '.join(map(str, scores.excluded))})" if scores.excluded else ""
    lines += [
        "",
        f"{scores.participants} participants, {len(scores.excluded)} of them excluded for a failed"
        f" catch pair{excluded}; {len(scores.unchecked)} counted without having seen one",
        f"same choice in hidden repeats: {share_text(scores.repeat_agreement)}",
        f"choice of the left side: {share_text(scores.left)}, p {p_text(scores.left_p)}",
    ]
    if scores.skipped:
        lines.append(f"pairs that a browser could not show: {scores.skipped}")
    return "\n".join(lines)


def _strengths(scores: "Scores") -> list[tuple[str, ...]]:
    rows = []
    for each in scores.strengths:
        ends = each.interval
        interval = "-" if ends is None else f"{ends[0]:+.2f} to {ends[1]:+.2f}"
        rows.append((each.effect, each.kind, each.method, f"{each.log_strength:+.2f}", interval))
    return rows


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of equal length as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ([cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows)
    return ["  ".join(cells).rstrip() for cells in padded]


def percent(share: float | None) -> str:
    """Return a share in percent."""
    return "-" if share is None else f"{share:.0%}"


def span(interval: tuple[float, float]) -> str:
    """Return an interval of shares in percent."""
    return f"{interval[0]:.0%} to {interval[1]:.0%}"


def share_text(share: "Share") -> str:
    """Return a share with its counts and interval."""
    if not share.votes:
        return "no votes"
    return f"{share.wins} of {share.votes}, {percent(share.share)} ({span(share.interval)})"


def p_text(p: float) -> str:
    """Return a p-value with two digits; small ones as a bound."""
    return "<.0001" if p < 1e-4 else f"{p:.2g}"
