"""Where the configuration files are."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def conf_dir() -> Path:
    """The folder of ``train.yaml``: inside an installed package, or beside it in a checkout.

    The checkout comes first: an editable install may have left a stale copy in the package.
    """
    beside = PACKAGE.parent / "conf"
    is_checkout = (PACKAGE.parent / "pyproject.toml").is_file() and (beside / "train.yaml").is_file()
    return beside if is_checkout else PACKAGE / "conf"
