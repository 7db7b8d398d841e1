"""README's examples run as they stand."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```", README.read_text(), flags=re.DOTALL | re.MULTILINE)


def test_there_is_one_for_each_of_three_people():
    assert len(EXAMPLES) >= 3


@pytest.mark.parametrize("source", EXAMPLES, ids=lambda source: source.strip().splitlines()[-1][:40])
def test_example_runs(source, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(source, str(README), "exec"), names)
    if "scene" in names:
        assert (tmp_path / "out" / "report.html").is_file()
        assert "cone" in capsys.readouterr().out
    if "partition" in names:
        assert abs(float(names["partition"].sizes.sum()) - 1) < 1e-6
    if "labels" in names:
        assert sorted(set(names["labels"])) == [0, 1, 2]


def test_quick_start_has_two_lines():
    section = README.read_text().split("## Quick start", 1)[1].split("\n## ", 1)[0]
    blocks = re.findall(r"^```\n(.*?)\n```", section, flags=re.DOTALL | re.MULTILINE)
    assert len(blocks) == 2 == section.count("\n```\n") / 2
    assert all("\n" not in block and not block.startswith("#") for block in blocks)
