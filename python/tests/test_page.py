"""Runs the examples of docs/python.md from top to bottom, and checks their types."""

import mypy.api
from conftest import SHIPPED, beside

PAGE = beside("docs") / "python.md"


def examples():
    text, blocks = PAGE.read_text(), []
    for block in text.split("```")[1::2]:
        language, code = block.split("\n", 1)
        if language == "python":
            blocks.append(code)
    return blocks


def test_every_example_runs_and_runs_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policies").symlink_to(SHIPPED)
    blocks = examples()
    assert len(blocks) >= 2
    for _ in range(2):
        names = {}
        for block in blocks:
            exec(compile(block, str(PAGE), "exec"), names)


#: The imports of the page's first examples.
IMPORTS = """
import gymnasium
import numpy as np
import qube_hil
from qube_hil import Normal, QubeVectorEnv, Uniform
"""


def test_mypy_finds_nothing_wrong_with_an_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = []
    for index, block in enumerate(examples()):
        files.append(tmp_path / f"example_{index}.py")
        files[-1].write_text(IMPORTS + block)
    found, trouble, code = mypy.api.run(["--strict", *map(str, files)])
    assert code == 0, found + trouble
