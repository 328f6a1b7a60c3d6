"""Write the models of all launch files again, with the `launch` of this machine."""

import json
import tempfile
from pathlib import Path

from tests.launch_files import CASES, MODELS, make_package, resolved

with tempfile.TemporaryDirectory() as prefix:
    share = make_package(Path(prefix))
    MODELS.mkdir(exist_ok=True)
    for name, arguments in CASES.items():
        text = json.dumps(resolved(share, name, *arguments), indent=1)
        (MODELS / f"{name}.json").write_text(text + "\n")
