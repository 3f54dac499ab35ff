"""The examples of docs/python.md, run from top to bottom."""

from conftest import SHIPPED, beside

PAGE = beside("docs") / "python.md"


def examples():
    text, blocks = PAGE.read_text(), []
    for block in text.split("```")[1::2]:
        language, code = block.split("\n", 1)
        if language == "python":
            blocks.append(code)
    return blocks


def test_every_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policies").symlink_to(SHIPPED)
    blocks = examples()
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
