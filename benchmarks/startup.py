"""How long until something happens: `climatenerf --help`, `fit --help`, imports?

python benchmarks/startup.py
python benchmarks/startup.py --repeats 20
"""

import argparse
import subprocess

from common import PYTHON, measure, report

COMMANDS = {
    "climatenerf --help": ["-m", "climatenerf", "--help"],
    "climatenerf fit --help": ["-m", "climatenerf", "fit", "--help"],
    "climatenerf render --help": ["-m", "climatenerf", "render", "--help"],
    "python, nothing": ["-c", "pass"],
    "import climatenerf": ["-c", "import climatenerf"],
    "import climatenerf.scene": ["-c", "import climatenerf.scene"],
    "import climatenerf.field.field": ["-c", "import climatenerf.field.field"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()

    def run(words: list[str]) -> None:
        subprocess.run([PYTHON, *words], stdout=subprocess.DEVNULL, check=True)

    rows = {
        name: measure(lambda words=words: run(words), options.repeats)
        for name, words in COMMANDS.items()
    }
    report("wall seconds of a fresh process", rows)


if __name__ == "__main__":
    main()
