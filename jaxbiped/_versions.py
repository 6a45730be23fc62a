"""The one version rule that pip does not keep for us: MuJoCo and MJX must be the same 3.17 release.

mujoco-mjx does not pin its mujoco, so an upgrade of one leaves the other behind. No JAX or MuJoCo is imported
here: the check runs before anything else does.
"""

from importlib import metadata

_SERIES = "3.17"


def check_mujoco_pair(mujoco: str, mjx: str) -> None:
    """Raise unless both packages are of the supported series, and of the same release.

    Args:
        mujoco: version of the package mujoco, for example "3.17.0".
        mjx: version of the package mujoco-mjx.

    Raises:
        ImportError: with what was found, what is wanted, and the command that mends it.
    """
    if mujoco == mjx and mujoco.split(".")[:2] == _SERIES.split("."):
        return
    raise _mismatch(mujoco, mjx)


def check_installed() -> None:
    """Check the installed mujoco and mujoco-mjx; see `check_mujoco_pair`.

    Raises:
        ImportError: when a package is missing or the two do not go together.
    """
    mujoco, mjx = _installed("mujoco"), _installed("mujoco-mjx")
    if mujoco is None or mjx is None:
        raise _mismatch(mujoco, mjx)
    check_mujoco_pair(mujoco, mjx)


def _installed(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _mismatch(mujoco: str | None, mjx: str | None) -> ImportError:
    return ImportError(
        f"jaxbiped needs mujoco and mujoco-mjx of one and the same release {_SERIES}.x, but found "
        f"mujoco {mujoco or '(not installed)'} and mujoco-mjx {mjx or '(not installed)'}. "
        f"Mend it with: pip install 'mujoco=={_SERIES}.*' 'mujoco-mjx=={_SERIES}.*'"
    )
