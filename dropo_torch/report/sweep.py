"""The page of a sweep over ε: the choice, its reason, and every fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import yaml

from dropo_torch.report.figures.sweep import epsilon_panel
from dropo_torch.report.page import Frame, write_page
from dropo_torch.studies.sweep import Sweep


def write_sweep_report(path: str | Path, sweep: Sweep, *, use: Mapping[str, Any], **frame: Unpack[Frame]) -> None:
    """Write the report of a sweep over ε.

    Args:
        path: the HTML file; written whole or not at all.
        sweep: the sweep.
        use: the config's keys that are recommended, name → value.
        frame: title, config and versions: :class:`~dropo_torch.report.page.Frame`.
    """
    values = [p.robust_log_likelihood if sweep.noisy_starts else p.log_likelihood for p in sweep.points]
    epsilon, mse, likelihood = np.array([[p.epsilon, p.mse, v] for p, v in zip(sweep.points, values, strict=True)]).T
    content = {
        "title": "Choice of ε",
        "use": yaml.safe_dump(dict(use), sort_keys=False, allow_unicode=True).strip(),
        "sweep": sweep,
        "rows": list(zip(sweep.points, likelihood.tolist(), strict=True)),
        "mse_figure": epsilon_panel(epsilon, mse, sweep.chosen, "mean squared difference", log=True),
        "likelihood_figure": epsilon_panel(epsilon, likelihood, sweep.chosen, "log-likelihood (nats)", log=False),
    }
    write_page(path, "sweep.html", content, frame)
