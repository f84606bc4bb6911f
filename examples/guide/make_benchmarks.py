"""Write the tables of reports into the benchmarks page, between its marks.

    python examples/guide/make_benchmarks.py [out/report/report.json ...]

Each report that is given is kept in the folder data/, under the name of the folder that it lies in. The page is made of
all that lie there, every table with its machine; a table that none of them has stays as it is.
"""

import argparse
import json
import re
import subprocess
from pathlib import Path
from typing import Any

from torchbokeh.report.chapter import markdown

HERE = Path(__file__).parent
PAGE = HERE / "benchmarks.md"
DATA = HERE / "data"
MARKED = re.compile(r"(?<=<!-- report: )(?P<title>.+?) -->\n\n.*?(?=<!-- /report -->)", re.DOTALL)
DIGITS = 6
"""Of every number that is kept: no table shows more."""


def keep(report: Path) -> Path:
    """Keep a report in `DATA`: rounded, with the commit of this checkout, as small as it goes."""
    found = _rounded(json.loads(report.read_text(encoding="utf-8")))
    command = ["git", "-C", str(HERE), "rev-parse", "--short", "HEAD"]
    found["commit"] = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    for row in found["experiments"].get("chromatic_bands", []):
        row.pop("profile", None)  # for a plot
    DATA.mkdir(exist_ok=True)
    path = DATA / f"{report.resolve().parent.name}.json"
    path.write_text(json.dumps(found, separators=(",", ":")) + "\n", encoding="utf-8")
    return path


def _rounded(found: Any) -> Any:
    if isinstance(found, dict):
        return {key: _rounded(value) for key, value in found.items()}
    if isinstance(found, list):
        return [_rounded(value) for value in found]
    return float(f"{found:.{DIGITS}g}") if isinstance(found, float) else found


def sections(found: dict[str, Any]) -> dict[str, str]:
    """The sections of a report by their titles, each with a line that says where it was measured."""
    made = found["machine"]
    where = f"Measured at {found['commit']}: {made['processor']}, processors: {made['processors']}, "
    where += f"threads: {made['threads']}, Python {made['Python']}, torch {made['torch']}, numba {made['numba']}."
    parts = re.split(r"^## (.+)\n", markdown(found, []), flags=re.MULTILINE)
    return {title: f"{where}\n\n{text.strip()}" for title, text in zip(parts[1::2], parts[2::2], strict=True)}


def page(text: str, runs: list[dict[str, Any]]) -> str:
    """The page with the tables of the runs.

    Args:
        text: of the page.
        runs: reports, as `keep` leaves them.
    """
    made = [sections(found) for found in runs]

    def fill(mark: re.Match[str]) -> str:
        title = mark["title"]
        tables = [run[title] for run in made if title in run]
        return f"{title} -->\n\n" + "\n\n".join(tables) + "\n\n" if tables else mark[0]

    return MARKED.sub(fill, text)


def kept() -> list[dict[str, Any]]:
    """All reports in `DATA`, by name."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(DATA.glob("*.json"))]


def main() -> None:
    """Keep the reports that are given, and make the page anew."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("reports", nargs="*", type=Path, metavar="JSON", help="report.json of torchbokeh report")
    for report in parser.parse_args().reports:
        print(keep(report))
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8"), kept()), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()
