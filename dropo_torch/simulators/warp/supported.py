"""The lists in docs/warp.md that follow from the code.

``python -m dropo_torch.simulators.warp.supported`` writes them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import mujoco

from dropo_torch.simulators.warp.layout import DIRECT, FIELDS
from dropo_torch.simulators.warp.support import HARMLESS, INERT, INTEGRATORS
from dropo_torch.simulators.warp.tables import KINDS

#: Where the lists stand.
DOCS = Path(__file__).parents[3] / "docs" / "warp.md"
_BLOCK = "<!-- {name}: written by python -m dropo_torch.simulators.warp.supported -->\n{text}\n<!-- end -->"


def _name(member: object) -> str:
    """``plane`` of ``mjtGeom.mjGEOM_PLANE``."""
    return str(member).split("_", 1)[1].lower()


def contacts() -> str:
    """Which geoms may touch which, as a table."""
    geoms = sorted({g for pair in KINDS for g in pair}, key=int)
    said = dict.fromkeys(KINDS, "yes")
    rows = [["", *map(_name, geoms)], ["---"] * (1 + len(geoms))]
    for one in geoms:
        cells = [said.get((one, other), said.get((other, one), "")) for other in geoms]
        rows.append([_name(one), *cells])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def options() -> str:
    """Integrators and flags that are taken."""
    kinds: dict[str, tuple[type, Iterable[int]]] = {
        "integrators": (mujoco.mjtIntegrator, INTEGRATORS),
        "flags disabled": (mujoco.mjtDisableBit, _bits(mujoco.mjtDisableBit, HARMLESS)),
        "flags enabled": (mujoco.mjtEnableBit, _bits(mujoco.mjtEnableBit, INERT)),
    }  # fmt: skip
    return "\n".join(
        f"- {what}: {', '.join(f'`{_name(kind(value).name)}`' for value in sorted(values))}"
        for what, (kind, values) in kinds.items()
    )


def _bits(kind: type, flags: int) -> list[int]:
    members = kind.__members__.items()  # type: ignore[attr-defined]
    return [int(m) for name, m in members if flags & int(m) and not name.startswith("mjN")]


def parameters() -> str:
    """Fields that a parameter may write, a line for each kind of object."""
    kept = {field: keep for _, field, keep in DIRECT if keep}
    groups: dict[str, list[str]] = {}
    for field in FIELDS:
        first = f" (the first {kept[field]})" if field in kept else ""
        groups.setdefault(re.split(r"[._]", field)[0], []).append(f"`{field}`{first}")
    return "\n".join(f"- {', '.join(fields)}" for fields in groups.values())


def written(text: str) -> str:
    """Return a page with its lists as the code has them now.

    Raises:
        ValueError: a list has no place in the page.
    """
    for make in (contacts, options, parameters):
        name = make.__name__
        block = re.compile(f"<!-- {name}: .*?<!-- end -->", re.DOTALL)
        if len(block.findall(text)) != 1:
            raise ValueError(f"{len(block.findall(text))} places for {name}")
        before, after = block.split(text)
        text = before + _BLOCK.format(name=name, text=make()) + after
    return text


if __name__ == "__main__":
    DOCS.write_text(written(DOCS.read_text()))
