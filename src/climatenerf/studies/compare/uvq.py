"""UVQ (Apache-2.0) in a checkout of the user, as a process of its own: a score for each movie.

It was made to find compression and noise, and hardly separates good movies; ClimateNeRF's paper
warns of it. It was not run with the real weights here.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core import parsing
from climatenerf.core.errors import UserError
from climatenerf.core.storage import hash_of_files, read_json, write_json
from climatenerf.studies.compare.program import check_checkout, python_of, run_program
from climatenerf.studies.compare.settings import UvqSettings

LICENCE = "Apache-2.0, code and weights"
SCRIPT = "uvq_inference.py"
SCORES = {"1.0": "compression_content_distortion", "1.5": "uvq1p5_score"}
"""Key of the score, from 1 to 5, by version."""


@dataclass(frozen=True)
class Uvq:
    """UVQ of one version.

    Attributes:
        checkout: folder of its repository.
        version: of the model.
        python: of its environment.
    """

    checkout: Path
    version: str
    python: Path

    def score(self, movie: Path, work: Path) -> float:
        """Return the score of a movie, 1 to 5; a score that is kept from before is reused.

        Args:
            movie: the MP4 file.
            work: folder for the log and the kept score.

        Raises:
            UserError: the program fails, or writes no score.
        """
        kept, digest = work / "uvq.json", hash_of_files([movie])
        if kept.is_file():
            earlier = read_json(kept, "a score of UVQ")
            if earlier.get("movie") == digest and earlier.get("version") == self.version:
                return parsing.number(earlier, "score", str(kept))
        with tempfile.TemporaryDirectory(prefix="climatenerf-") as name:
            output = Path(name) / "scores.json"
            command = [self.python, SCRIPT, movie.resolve(), "--model_version", self.version]
            command += ["--output", output]
            run_program(command, self.checkout, work / "uvq.log", "UVQ")
            if not output.is_file():
                raise UserError(
                    f"UVQ wrote no score of {movie}; see {work / 'uvq.log'}: it needs ffmpeg and"
                    " ffprobe"
                )
            score = parsing.number(
                read_json(output, "the score of UVQ"), SCORES[self.version], "it"
            )
        write_json(kept, {"movie": digest, "version": self.version, "score": score})
        return score


def uvq(settings: UvqSettings) -> Uvq | None:
    """Return UVQ, or None without a checkout.

    Raises:
        UserError: the checkout is none.
    """
    if settings.checkout is None:
        return None
    checkout = check_checkout(settings.checkout, SCRIPT, "UVQ")
    return Uvq(checkout, settings.version, python_of(settings.python))
