"""The packages: ``dropo_torch``, and the folder ``sims``, which is installed as ``dropo_sims``."""

from setuptools import find_packages, setup

sims = ["dropo_sims", *(f"dropo_sims.{name}" for name in find_packages("sims"))]
setup(packages=[*find_packages(include=["dropo_torch*"]), *sims], package_dir={"dropo_sims": "sims"})
