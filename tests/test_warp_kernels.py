"""How the kernels' code is written: what keeps NVIDIA's compiler from copying and inlining all of it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from dropo_torch.simulators import warp

#: Structs of kilobytes, which a call is not to copy.
LARGE = {"Tables", "World"}


def device_functions() -> Iterator[tuple[str, ast.FunctionDef, ast.expr]]:
    """File, definition and decorator of every function that is compiled by Warp."""
    for file in sorted(Path(warp.__path__[0]).glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                for decorator in node.decorator_list:
                    if ast.unparse(decorator).partition("(")[0] in ("wp.func", "wp.func_native"):
                        yield file.name, node, decorator


@pytest.mark.parametrize("large", sorted(LARGE))
def test_large_structs_are_passed_by_reference(large: str) -> None:
    annotations = [
        (f"{file}: {node.name}", ast.unparse(argument.annotation))
        for file, node, _ in device_functions()
        for argument in node.args.args
        if argument.annotation
    ]
    assert f"wp.ref[{large}]" in {annotation for _, annotation in annotations}
    assert [name for name, annotation in annotations if annotation == large] == []


def test_every_function_says_whether_it_is_inlined() -> None:
    silent = [
        f"{file}: {node.name}"
        for file, node, decorator in device_functions()
        if ast.unparse(decorator) not in ("wp.func(inline=True)", "wp.func(inline=False)")
        and not ast.unparse(decorator).startswith("wp.func_native(")
    ]
    assert silent == []
