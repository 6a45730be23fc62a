"""What the README shows runs as it stands."""

import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_example_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(example, "README.md", "exec"), {})
    planned, walked = capsys.readouterr().out.splitlines()[-2:]
    assert planned == "the planned ZMP stays 75 mm inside the support"
    assert walked.startswith("ok ")
