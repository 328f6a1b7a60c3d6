"""Reports from sources to files."""

from __future__ import annotations

from pathlib import Path

from rosrm.errors import ConfigError
from rosrm_report.extract import report_of
from rosrm_report.model import Report
from rosrm_report.page import page_of
from rosrm_report.sources import read_source, with_logs


def read_report(source: Path, title: str = "") -> Report:
    """Return the report of a source; of a directory with logs, with the last lines of failures.

    Raises:
        RosrmError: nothing in the source is readable.
    """
    report = report_of(read_source(source), title)
    return with_logs(report, source) if source.is_dir() else report


def write_page(report: Report, output: Path) -> None:
    """Write a report as HTML; a failure leaves an older file unchanged.

    Raises:
        ConfigError: the file cannot be written.
    """
    part = output.with_name(f"{output.name}.new")
    try:
        part.write_text(page_of(report), encoding="utf-8")
        part.replace(output)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ConfigError(f"--output {output}: cannot be written: {error.strerror}") from None
