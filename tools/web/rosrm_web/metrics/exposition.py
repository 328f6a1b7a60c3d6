"""Metrics as text for Prometheus."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from prometheus_client import (
    CollectorRegistry,
    Gauge,
    disable_created_metrics,
    generate_latest,
)

from rosrm_web.metrics import table
from rosrm_web.metrics.sampling import of_load, samples

if TYPE_CHECKING:
    from rosrm.model.rows import Listing
    from rosrm_web.metrics.counting import EventMetrics
    from rosrm_web.metrics.sampling import Sample

MEDIA_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

disable_created_metrics()  # a series with a time of creation beside each counter


def exposition(
    listing: Listing | None, seconds: float = 0.0, counted: EventMetrics | None = None,
    load: Mapping[str, float] = MappingProxyType({}), more: Iterable[Sample] = (),
) -> bytes:  # fmt: skip
    """Return all metrics as text.

    Args:
        listing: with hosts, processes, applications and failing plugins; None: no master answers.
        seconds: in which the master answered.
        counted: metrics of events; None: none were counted.
        load: of the master, as `Client.master_load` returns it.
        more: values of the process that writes the text.
    """
    values: list[Sample] = [(table.UP, (), float(listing is not None)), *more]
    if listing is not None:
        values += [*samples(listing, seconds), *of_load(load)]
    after = b"" if counted is None else bytes(generate_latest(counted.registry))
    return _present(values) + after


def _present(values: Iterable[Sample]) -> bytes:
    registry = CollectorRegistry()
    gauges: dict[str, Gauge] = {}
    for metric, labels, value in values:
        if metric.name not in gauges:
            gauges[metric.name] = Gauge(
                metric.name, metric.meaning, metric.labels, registry=registry
            )
        gauge = gauges[metric.name]
        (gauge.labels(*labels) if labels else gauge).set(value)
    return bytes(generate_latest(registry))
