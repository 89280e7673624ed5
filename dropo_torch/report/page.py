"""The frame of every report: a template filled with its content, in one HTML file.

A page is a function ``write_..._report`` in a module of its own, which puts the content together, a template beside it,
and a module of :mod:`~dropo_torch.report.figures`. Pages need no network and no scripts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml
from markupsafe import Markup

from dropo_torch.report.formatting import FILTERS
from dropo_torch.support.files import write_atomically

Versions = Mapping[str, str] | None
Config = Mapping[str, Any] | None


def write_page(
    path: str | Path, template: str, title: str, content: Mapping[str, Any], *, config: Config, versions: Versions
) -> None:
    """Write a page as one self-contained file, whole or not at all.

    Args:
        path: the HTML file.
        template: the file of its template.
        title: of the page.
        content: what the template names; ``facts`` are pairs for the table of how the result was computed.
        config: the run's config, printed as YAML.
        versions: name → version of what the result depends on.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {f.__name__: f for f in FILTERS} | {"svg": _svg}
    frame = {"title": title, "facts": (), "config": config_yaml(config), "versions": dict(versions or {})}
    page = environment.get_template(template).render({**frame, **content})
    write_atomically(Path(path), page.encode())


def config_yaml(config: Config) -> str:
    """Return a config as YAML; empty for ``None``."""
    if config is None:
        return ""
    document = json.loads(json.dumps(dict(config), default=_plain_data))
    options: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "width": 100}
    return "".join(
        yaml.safe_dump({key: value}, default_flow_style=None if isinstance(value, (dict, list)) else False, **options)
        for key, value in document.items()
    )


def _svg(figure: Any, grow: bool = True) -> Markup:
    from dropo_torch.report.figures import to_svg  # heavy, and not every page has a figure

    return Markup(to_svg(figure, grow=grow))


def _plain_data(value: Any) -> Any:
    """JSON for what JSON does not know."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)
