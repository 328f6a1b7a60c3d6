"""Words of a command that name files in the working directory."""

from __future__ import annotations

import pytest

from rosrm.model.relative_files import MOST, relative_files
from rosrm.model.values import Container, ProcessSpec


@pytest.mark.parametrize(
    ("command", "found"),
    [
        ("python3 ./x.py", ("./x.py",)),
        ("python3 x2.py out.txt", ("x2.py",)),
        ("python3 -u x2.py", ("x2.py",)),
        ("bash scripts/run", ("scripts/run",)),
        ("/usr/bin/python3.12 tools/run", ("tools/run",)),
        ("node_of_mine --config=conf/a.yaml -c ../b.toml", ("conf/a.yaml", "../b.toml")),
        ("talker --ros-args --params-file a.yaml", ()),
        ("python3 /opt/x.py ~/b.yaml -m module", ()),
        ("ros2 topic pub chatter std_msgs/msg/String", ()),
        ("curl http://robot/a.json image:=b.yaml", ()),
        ("ping example.com", ()),
        ("./run.py", ()),
        (" ".join(["cat", *(f"{n}.py" for n in range(20))]), tuple(f"{n}.py" for n in range(MOST))),
        ("", ()),
    ],
)
def test_words_that_name_files_to_read(command, found):
    spec = ProcessSpec(name="one", command=tuple(command.split()))
    assert relative_files(spec) == found


def test_the_files_of_a_module_and_of_an_image():
    module = ProcessSpec(name="one", module="mapper", arguments=("conf/a.yaml",))
    of_image = Container(image="img", engine="podman")
    image = ProcessSpec(name="one", command=("cat", "a.yaml"), container=of_image)
    assert relative_files(module) == ("conf/a.yaml",)
    assert relative_files(image) == ()
