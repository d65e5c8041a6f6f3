"""Figures like those of the paper, drawn from simulated scenes and the authors' data.

    python experiments/paper_figures/make.py                       # all, about a quarter of an hour
    python experiments/paper_figures/make.py merging sampled_cuts  # some figures, by name
    python experiments/paper_figures/make.py --smoke --out DIR     # all at small size, a minute

`merging` needs the authors' particles (r1.py); if they are missing, the script prints a message and skips the figure.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

import matplotlib.style

FIGURES = ("merging", "teaser", "sampled_cuts")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=f"{', '.join(FIGURES)}; default: all")
    parser.add_argument(
        "--smoke", action="store_true", help="small and quick; shows only that all works; needs --out"
    )
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "results")
    options = parser.parse_args()
    if options.smoke and options.out == parser.get_default("out"):
        parser.error("--smoke would overwrite the results: name another folder with --out")
    unknown = [name for name in options.figures if name not in FIGURES]
    if unknown:
        parser.error(f"no figure is called {unknown[0]!r}; there are {', '.join(FIGURES)}")
    with matplotlib.style.context("mstfilter.app.report.figures"):
        for name in options.figures or FIGURES:
            made = importlib.import_module(name).make(options.out, options.smoke)
            print(f"{name}:", ", ".join(map(str, made)) or "left out, the authors' particles are absent", flush=True)


if __name__ == "__main__":
    main()
