"""The examples of docs/python.md, run from top to bottom."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent
PAGE = next(page for page in (FOLDER / "python.md", FOLDER.parent / "docs/python.md") if page.exists())


def examples():
    text, blocks = PAGE.read_text(), []
    for block in text.split("```")[1::2]:
        language, code = block.split("\n", 1)
        if language == "python":
            blocks.append(code)
    return blocks


def test_every_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for shipped in ("policies",):
        place = next(p for p in (FOLDER / shipped, FOLDER.parent / shipped) if p.exists())
        (tmp_path / shipped).symlink_to(place)
    blocks = examples()
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
