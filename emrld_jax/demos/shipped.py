"""Where demonstrations are found: by quality those that the package ships, or by path."""

from __future__ import annotations

from pathlib import Path

from emrld_jax.demos.archive import DemoError

QUALITIES = ("optimal", "suboptimal")
DATA = Path(__file__).parent / "data"


def resolve(demos: str, environment: str, setting: str = "demos") -> Path:
    """The file that `demos` names.

    Args:
        demos: "optimal" or "suboptimal" for the shipped demonstrations, or the path of a file.
        environment: name of the environment, for the shipped ones.
        setting: what it was given as, for messages.

    Raises:
        DemoError: neither a quality nor a path, or there is no such file.
    """
    if demos in QUALITIES:
        path = DATA / f"{environment}_{demos}.npz"
        if not path.is_file():
            raise DemoError(
                f"no {demos} demonstrations of {environment} are shipped ({path} is missing); "
                "make them with python -m emrld_jax.make_demos, or give the path of a .npz file"
            )
        return path
    if not demos.endswith(".npz") and "/" not in demos and "\\" not in demos:
        raise DemoError(
            f"{setting}={demos!r} is unknown; allowed: {', '.join(QUALITIES)}, or a path to a .npz "
            "file"
        )
    path = Path(demos).expanduser()
    if not path.is_file():
        raise DemoError(f"{setting}={demos}: there is no such file")
    return path
