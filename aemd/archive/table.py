"""Tuning and diagnosis of every file of an archive: one table, and one page."""

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from aemd.archive.places import Found, find
from aemd.archive.work import workers
from aemd.display import counting
from aemd.errors import AemdError, RecordingError
from aemd.record.source import Selection

__all__ = ["ArchiveTable", "diagnose_archive", "tune_archive", "write_page"]

_HANDED_OUT = 64  # files at a time: workers never wait, and an archive of a million is no million tasks
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #1f2933; }}
h1 {{ font-size: 1.4rem; }} pre {{ white-space: pre-wrap; background: #f5f7fa; padding: 1rem; }}
table {{ border-collapse: collapse; width: 100%; margin-bottom: 2rem; }}
th, td {{ text-align: left; padding: .3rem .8rem .3rem 0; border-bottom: 1px solid #d9e2ec; vertical-align: top; }}
.failed {{ color: #b91c1c; }} summary {{ cursor: pointer; padding: .2rem 0; }}
</style></head><body>
<h1>{title}</h1>
<p>{count}{failed}</p>
<table><thead><tr>{head}</tr></thead><tbody>
{rows}
</tbody></table>
{details}
</body></html>
"""


@dataclass(frozen=True, slots=True)
class ArchiveTable:
    """What was found in each file."""

    archive: str
    columns: tuple[str, ...]
    rows: tuple[dict[str, Any], ...]
    """In the order of the files' names."""
    failed: tuple[str, ...]
    """One line for each file that gave no row."""
    texts: dict[str, str]
    """The whole report of each file, where there is one."""

    def as_mapping(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"archive": self.archive, "files": list(self.rows), "failed": list(self.failed)}

    def __rich__(self) -> Table:
        """Return it for a terminal."""
        table = Table(title=self.archive, title_justify="left", box=box.SIMPLE_HEAD)
        for column in self.columns:
            table.add_column(_head(column), overflow="fold")
        for row in self.rows:
            table.add_row(*(_cell(row, column) for column in self.columns))
        return table


def tune_archive(
    pattern: str,
    out: Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    console: Console | None = None,
    **options: Any,
) -> ArchiveTable:
    """Tune `imm` in each file of an archive, and write a model file for each into a folder.

    Args:
        pattern: which files.
        out: the folder.
        jobs: processes on this machine.
        scheduler: address of a dask cluster in the place of processes.
        console: where progress is shown; None for nowhere.
        options: of `tune_recording`.

    Raises:
        UsageError: no such file.
        InstrumentError: the scheduler does not answer.
    """
    columns = ("file", "readings", "kind", "log_likelihood", "model")
    folder = str(out.absolute())
    return _each(pattern, columns, partial(_tune, folder=folder, options=options), jobs, scheduler, console)


def diagnose_archive(
    pattern: str,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    model: Path | None = None,
    line_frequency_hz: float | None = None,
    selection: Selection | None = None,
    console: Console | None = None,
) -> ArchiveTable:
    """Diagnose each file of an archive.

    Args:
        pattern: which files.
        jobs: processes on this machine.
        scheduler: address of a dask cluster in the place of processes.
        model: a model under criticism instead of each file's fitted base.
        line_frequency_hz: of the mains, where it is known.
        selection: which number is the reading, in files of another program.
        console: where progress is shown; None for nowhere.

    Raises:
        UsageError: no such file.
        InstrumentError: the scheduler does not answer.
    """
    columns = ("file", "verdict", "readings", "rate_hz", "findings")
    work = partial(_diagnose, model=model, line_frequency_hz=line_frequency_hz, selection=selection)
    return _each(pattern, columns, work, jobs, scheduler, console)


def write_page(table: ArchiveTable, title: str, path: Path) -> None:
    """Write the table as a page, the reports of the files below it.

    Raises:
        RecordingError: the page cannot be written.
    """
    places = {name: f"report-{number}" for number, name in enumerate(table.texts, start=1)}
    rows = []
    for row in table.rows:
        cells = {column: escape(_cell(row, column)) for column in table.columns}
        if row["file"] in places:
            cells["file"] = f'<a href="#{places[row["file"]]}">{cells["file"]}</a>'
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells.values()) + "</tr>")
    rows += [f'<tr><td class="failed" colspan="{len(table.columns)}">{escape(line)}</td></tr>' for line in table.failed]
    details = [
        f'<details id="{places[name]}"><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>'
        for name, text in table.texts.items()
    ]
    count, failed = len(table.rows) + len(table.failed), len(table.failed)
    page = _PAGE.format(
        title=escape(f"{title}: {table.archive}"),
        count=f"{count:,} file{'' if count == 1 else 's'}",
        failed=f", {failed:,} of which could not be read." if failed else ".",
        head="".join(f"<th>{escape(_head(column))}</th>" for column in table.columns),
        rows="\n".join(rows),
        details="\n".join(details),
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from error


Work = Callable[[Found], tuple[dict[str, Any], str]]


def _each(
    pattern: str, columns: Sequence[str], work: Work, jobs: int, scheduler: str | None, console: Console | None
) -> ArchiveTable:
    files = find(pattern)
    rows: dict[str, dict[str, Any]] = {}
    texts, failed = dict[str, str](), dict[str, str]()
    with counting("files", console) as bar, workers(jobs, scheduler) as executor:
        under_way: dict[Future[tuple[dict[str, Any], str]], Found] = {}
        waiting = list(reversed(files))
        while waiting or under_way:
            while waiting and len(under_way) < _HANDED_OUT:
                found = waiting.pop()
                under_way[executor.submit(work, found)] = found
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                found = under_way.pop(future)
                try:
                    rows[found.name], text = future.result()
                    if text:
                        texts[found.name] = text
                except AemdError as error:
                    failed[found.name] = str(error)
                except Exception as error:  # noqa: BLE001 - a fault of one file must not cost the others
                    failed[found.name] = f"{found.place.url}: {type(error).__name__}: {' '.join(str(error).split())}"
                bar(len(rows) + len(failed), len(files))
    return ArchiveTable(
        archive=pattern,
        columns=tuple(columns),
        rows=tuple(rows[name] for name in sorted(rows)),
        failed=tuple(failed[name] for name in sorted(failed)),
        texts={name: texts[name] for name in sorted(texts)},
    )


def _tune(found: Found, *, folder: str, options: dict[str, Any]) -> tuple[dict[str, Any], str]:
    from aemd.tune import tune_recording  # noqa: PLC0415 - with its compiled kernels, where it is needed

    out = Path(folder) / Path(found.name).with_suffix(".toml")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{out.parent}: cannot be made: {(error.strerror or str(error)).lower()}") from error
    with found.place.fetched() as path:
        result = tune_recording(path, out, **options)
    row = {"file": found.name, "readings": result.readings, "kind": result.kind}
    return {**row, "log_likelihood": result.log_likelihood, "model": str(out)}, ""


def _diagnose(
    found: Found, *, model: Path | None, line_frequency_hz: float | None, selection: Selection | None
) -> tuple[dict[str, Any], str]:
    from aemd.diagnose import diagnose, format_diagnosis  # noqa: PLC0415 - see above
    from aemd.tables import import_mcap  # noqa: PLC0415 - see above

    with found.place.fetched() as path, TemporaryDirectory() as folder:
        source = path
        if selection:
            source = Path(folder) / path.name
            import_mcap(path, source, selection=selection)
        result = diagnose(source, model=model, line_frequency_hz=line_frequency_hz)
    causes = [finding.cause for finding in result.findings]
    row = {"file": found.name, "verdict": result.verdict, "readings": result.n, "rate_hz": result.rate_hz}
    return {**row, "left_out": result.left_out, "findings": causes}, format_diagnosis(result)


def _head(column: str) -> str:
    """Return a column's name for a person; a unit stands in brackets."""
    return "rate (Hz)" if column == "rate_hz" else column.replace("_", " ")


def _cell(row: dict[str, Any], column: str) -> str:
    text = _say(row[column])
    if column == "readings" and row.get("left_out"):
        return f"first {text} of {row['readings'] + row['left_out']:,}"
    return text.replace("_", " ") if column == "verdict" else text


def _say(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(str(item).replace("_", " ") for item in value) or "-"
    return f"{value:,}" if isinstance(value, int) else str(value)
