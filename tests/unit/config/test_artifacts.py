"""Artifacts in a work file: paths, names, placeholders."""

from __future__ import annotations

import pytest

from rosrm.config.work import load_work
from rosrm.errors import ConfigError, Refused
from rosrm.model.artifacts import Artifact, artifacts_fault
from rosrm.model.values import ProcessSpec
from rosrm.ros.convert import spec_from_msg, spec_to_msg

DIGEST = "0123456789abcdef" * 4


def work(artifacts: str, command: str = "[python3, '{artifacts}/run.py']") -> str:
    return f"processes: [{{name: a, command: {command}, artifacts: {artifacts}}}]"


def test_paths_are_relative_to_the_work_file(file, tmp_path):
    """The specs have absolute paths, in the order of the names."""
    path = file(work("{run.py: ./run.py, data/x: ../x}"))
    (path.parent / "run.py").touch()
    (path.parent.parent / "x").touch()
    (spec,) = load_work(path)
    assert [(one.name, one.digest) for one in spec.artifacts] == [("data/x", ""), ("run.py", "")]
    assert [one.source for one in spec.artifacts] == [
        str(path.parent / ".." / "x"), str(path.parent / "run.py"),
    ]  # fmt: skip
    assert spec.command == ("python3", "{artifacts}/run.py")


def test_a_program_in_the_artifacts_is_not_looked_up_beside_the_work_file(file):
    """`{artifacts}` at the beginning of a path is a directory on the host."""
    path = file(work("{run.sh: run.sh}", "'{artifacts}/run.sh'"))
    (path.parent / "run.sh").touch(mode=0o755)
    assert load_work(path)[0].command == ("{artifacts}/run.sh",)


def test_a_program_in_the_artifacts_must_be_executable(file):
    """Otherwise each host would refuse it in turn."""
    path = file(work("{run.sh: run.sh}", "'{artifacts}/run.sh'"))
    (path.parent / "run.sh").touch(mode=0o644)
    remedy = r"command: \{artifacts\}/run.sh is not executable. Run `chmod \+x run.sh`, or begin"
    with pytest.raises(ConfigError, match=remedy):
        load_work(path)


def test_a_missing_file_is_an_error_at_its_place(file):
    """Unless the caller needs only the names of the processes."""
    path = file(work("{run.py: ./none.py}"))
    with pytest.raises(ConfigError, match=r":1:\d+: artifacts.run.py: .*none.py: there is no such"):
        load_work(path)
    assert load_work(path, check_artifacts=False)[0].name == "a"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("../x", "has '..'"), ("/x", "absolute"), ("a//b", "no plain relative path"),
        ("./x", "no plain relative path"), ("a/../b", "has '..'"), ('""', "no plain relative path"),
    ],
)  # fmt: skip
def test_a_name_outside_of_the_directory_is_refused(file, name, says):
    """In the work file, and again at the master."""
    path = file(work(f"{{{name}: run.py}}"))
    (path.parent / "run.py").touch()
    with pytest.raises(ConfigError, match=says):
        load_work(path)
    spec = ProcessSpec("a", command=("x",), artifacts=(Artifact(name.strip('"'), DIGEST, 5),))
    with pytest.raises(Refused, match=says):
        spec_from_msg(spec_to_msg(spec))


def test_no_artifact_lies_in_another_one(file):
    """The file would be missing, or hide one of the directory."""
    assert "lies in 'scripts'" in artifacts_fault((Artifact("scripts/x"), Artifact("scripts")))
    assert artifacts_fault((Artifact("scripts"), Artifact("scripts-2/x"))) == ""


def test_the_placeholder_needs_artifacts(file):
    """Otherwise a program would get the text itself."""
    with pytest.raises(ConfigError, match=r"command: \{artifacts\} needs `artifacts:`"):
        load_work(file(work("{}")))


def test_artifacts_cross_the_wire_without_their_paths():
    """The paths of the submitting machine mean nothing elsewhere, and may be private."""
    artifact = Artifact("x", DIGEST, 5, source="/home/ada/x")
    spec = ProcessSpec("a", command=("x",), artifacts=(artifact,))
    received = spec_from_msg(spec_to_msg(spec))
    assert received == spec
    assert received.artifacts[0].source == ""


@pytest.mark.parametrize(
    ("artifact", "says"),
    [(Artifact("x"), "no digest"), (Artifact("x", DIGEST[:-1] + "G", 5), "no digest"),
     (Artifact("x", DIGEST), "0 bytes"), (Artifact("x", DIGEST, 10**14), "bytes; allowed")],
)  # fmt: skip
def test_a_spec_without_contents_is_refused(artifact, says):
    """A client that did not send them gets the reason."""
    spec = ProcessSpec("a", command=("x",), artifacts=(artifact,))
    with pytest.raises(Refused, match=says):
        spec_from_msg(spec_to_msg(spec))
