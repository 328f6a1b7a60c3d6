"""No code calls a plugin without the guard: each access to a member of a contract is found."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import rosrm
from rosrm.extensions import contracts, sinks
from rosrm.extensions.registry import Registry

ROOT = Path(rosrm.__file__).parent
#: Parts of rosrm that use plugins.
SOURCES = (*ROOT.rglob("*.py"), *(ROOT.parent / "tools").rglob("*.py"))
#: Calls whose function arguments run within the guard.
GUARDS = frozenset({"ask", "guarded", "contained", "_guarded", "_ask", "_in_time", "asked"})
#: Functions that are only called within the guard, with the caller's line of reason.
WITHIN = {
    "probe_reads.py": "Sampler reads a probe in `_guarded`",
    "made.py": "the registry checks what an offer made in `guarded`",
}
#: Names that contracts share with other classes of rosrm; a receiver of these names is a plugin.
SHARED = frozenset({
    "close", "resources", "labels", "read", "send", "name", "devices", "members", "root", "reason",
    "prepare", "checkpoint", "restore", "discard", "pids", "choose", "mask", "periodic", "pace",
})  # fmt: skip
PLUGIN_NAMES = frozenset({
    "launcher", "probe", "_probe", "policy", "strategy", "filter", "pacing",
    "asked", "checking", "plugin", "thing", "made",
})  # fmt: skip
#: Receivers that are rosrm's own, or values without code of the plugin.
OWN = frozenset({
    "_launchers", "launchers", "_sampler", "outcome", "self",
    ("made", "resources"), ("made", "reason"), ("probe", "reason"),
})  # fmt: skip
#: Places in which such a name is no plugin.
NO_PLUGIN = ("rosrm/model", "rosrm/testing", "rosrm/node", "rosrm/cli/templates", "tools/report")


def _members() -> frozenset[str]:
    """Return the members of all contracts that plugins implement."""
    found = set()
    for module in (contracts, sinks):
        for _, kind in inspect.getmembers(module, inspect.isclass):
            is_contract = getattr(kind, "_is_protocol", False) and kind is not contracts.Sessions
            if is_contract and kind.__module__ == module.__name__:
                found |= {name for name in vars(kind) if not name.startswith("_")}
    return frozenset(found)


def _receiver(node: ast.Attribute) -> str:
    value = node.value
    return value.attr if isinstance(value, ast.Attribute) else getattr(value, "id", "")


def _accesses(tree: ast.Module, members: frozenset[str]) -> Iterator[tuple[ast.AST, list[ast.AST]]]:
    """Yield each access to a member of a plugin, with the nodes around it."""
    stack: list[tuple[ast.AST, list[ast.AST]]] = [(tree, [])]
    while stack:
        node, around = stack.pop()
        if isinstance(node, ast.Attribute) and node.attr in members:
            receiver = _receiver(node)
            if receiver in OWN or (receiver, node.attr) in OWN:
                continue
            if receiver in PLUGIN_NAMES or node.attr not in SHARED:
                yield node, around
        elif isinstance(node, ast.Call) and _calls_by_name(node, members):
            yield node, around
        stack += [(child, [*around, node]) for child in ast.iter_child_nodes(node)]


def _calls_by_name(call: ast.Call, members: frozenset[str]) -> bool:
    """Return True for a call that reaches a member by its name, or closes a plugin.

    That is `methodcaller("send", ...)`, `getattr(sink, "close")` or `closing(sink)`, whose block
    calls `close` at its end.
    """
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    texts = {one.value for one in call.args if isinstance(one, ast.Constant)} - {"reason"}
    inside = {getattr(one, "attr", getattr(one, "id", "")) for one in ast.walk(call)}
    if name == "closing":
        return bool(inside & (PLUGIN_NAMES | {"_made", "sink", "_sink"}))
    return name in {"methodcaller", "attrgetter", "getattr"} and bool(texts & members)


def _is_guarded(access: ast.AST, around: list[ast.AST], tree: ast.Module) -> bool:
    """Return True if an access is in an argument of a guard, or in a function that is one."""
    names = set()
    for node in around:
        if isinstance(node, ast.Call):
            called = node.func
            name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
            # Otherwise the property itself would run before the guard.
            is_late = isinstance(access, ast.Call) or any(
                isinstance(one, ast.Lambda) for one in around
            )
            if name in GUARDS and is_late:
                return True
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
    handed = {
        argument.id
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        and (getattr(call.func, "attr", "") or getattr(call.func, "id", "")) in GUARDS
        for argument in [*call.args, *(one.value for one in call.keywords)]
        if isinstance(argument, ast.Name)
    }
    return bool(names & handed)


def test_each_call_of_a_plugin_is_guarded() -> None:
    """A new call of a probe, policy, strategy, launcher or sink has to go through the guard."""
    members = _members()
    assert {"read", "score", "mask", "propose", "prepare", "leads", "send", "choose"} <= members
    beside = []
    for path in SOURCES:
        where = str(path.relative_to(ROOT.parent))
        if path.name in WITHIN or any(where.startswith(one) for one in NO_PLUGIN):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node, around in _accesses(tree, members):
            if not _is_guarded(node, around, tree):
                beside.append(f"{where}:{getattr(node, 'lineno', 0)}: {ast.unparse(node)}")
    assert beside == []


def test_only_a_guarded_sink_leaves_the_registry() -> None:
    """Calls of sinks need no search: mypy knows that each sink is a `GuardedSink`."""
    assert inspect.get_annotations(Registry.sink)["return"] == "GuardedSink"
    naming = {
        str(path.relative_to(ROOT.parent))
        for path in SOURCES
        if re.search(r"\bEventSink\b", path.read_text(encoding="utf-8"))
    }
    assert {
        one
        for one in naming
        if not one.startswith(
            ("rosrm/testing", "rosrm/__init__", "tools/alerts/rosrm_alerts/plugin")
        )
    } == {f"rosrm/extensions/{name}.py" for name in ("guarded_sink", "registry", "sinks")}


def test_the_finder_finds_a_call_beside_the_guard() -> None:
    """An unguarded call is found, and a guarded one is not."""
    members = _members()
    for line, expected in (
        ("strategy.propose(move)", False),
        ("calls.ask('migration', name, 'propose', lambda: strategy.propose(move), strategy)", True),
        ("def ask(): return strategy.propose(move)\ncalls.ask('m', name, 'propose', ask)", True),
        ("guarded(strategy.propose, whom=name)", False),
        ("guarded(partial(strategy.propose, move), whom=name)", False),
        ("with closing(registry.sink('mcap')) as one: one.go()", False),
        ("with closing(_made(chosen, registry)) as one: one.go()", False),
        ("methodcaller('close')(sink)", False),
        ("getattr(one, 'propose')(move)", False),
        ("guarded(partial(methodcaller('send', notices), sink), whom=name)", True),
    ):
        tree = ast.parse(line)
        ((node, around),) = _accesses(tree, members)
        assert _is_guarded(node, around, tree) is expected
