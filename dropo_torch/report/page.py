"""The frame of every report: a template filled with its content, in one HTML file.

A page is a function ``write_..._report`` in a module of its own, which puts the content together, a template beside it,
and a module of :mod:`~dropo_torch.report.figures`. Pages need no network; no page but that of a view has a script.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypedDict

import jinja2
import yaml

from dropo_torch.report.formatting import FILTERS
from dropo_torch.support.files import write_atomically


class Frame(TypedDict, total=False):
    """What every page can be given.

    Attributes:
        title: of the page; each kind has one of its own.
        config: the run's config, printed as YAML.
        versions: name → version of what the result depends on.
    """

    title: str
    config: Mapping[str, Any] | None
    versions: Mapping[str, str] | None


def write_page(path: str | Path, template: str, content: Mapping[str, Any], frame: Frame) -> None:
    """Write a page as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        template: the file of its template.
        content: what the template names; ``facts`` are pairs for the table of how the result was computed.
        frame: title, config and versions.
    """
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    from dropo_torch.report.figures import to_svg  # heavy, and read only once a page is written

    environment.filters |= {f.__name__: f for f in FILTERS} | {"svg": to_svg, "yaml": config_yaml}
    page = environment.get_template(template).render(
        {"facts": (), "config": None, "versions": None, **content, **frame}
    )
    write_atomically(Path(path), page.encode())


def folder_of(path: str | Path) -> str:
    """Return the folder of a page as a command takes it; of one elsewhere on the machine, but its name."""
    folder = Path(path).parent
    return folder.name if folder.is_absolute() else folder.as_posix()


def config_yaml(config: Mapping[str, Any]) -> str:
    """Return a config as YAML."""
    document = json.loads(json.dumps(dict(config), default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v)))
    options: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 100}
    return "".join(
        yaml.safe_dump({key: value}, default_flow_style=None if isinstance(value, (dict, list)) else False, **options)
        for key, value in document.items()
    )
