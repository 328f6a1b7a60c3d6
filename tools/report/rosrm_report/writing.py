"""Reports from sources to files."""

from __future__ import annotations

import os
from pathlib import Path

from rosrm.errors import ConfigError
from rosrm.runtime import durable
from rosrm.wording import reason_of
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

    Only the user of the command may read the file, because it may have lines of logs.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        os.close(durable.replace_atomically(str(output), page_of(report).encode()))
    except OSError as error:
        raise ConfigError(f"--output {output}: cannot be written: {reason_of(error)}") from None
