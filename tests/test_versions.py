"""The rule that mujoco and mujoco-mjx go together, and what a user reads when they do not."""

from importlib import metadata

import pytest

from jaxbiped import _versions

MEND = "pip install 'mujoco==3.17.*' 'mujoco-mjx==3.17.*'"


@pytest.fixture
def installed(monkeypatch):
    """Makes importlib.metadata answer from a dict of versions, in which a package may be missing."""

    def pretend(versions: dict[str, str]) -> None:
        def version(name: str) -> str:
            if name not in versions:
                raise metadata.PackageNotFoundError(name)
            return versions[name]

        monkeypatch.setattr(metadata, "version", version)

    return pretend


@pytest.mark.parametrize("version", ["3.17.0", "3.17.2", "3.17.10"])
def test_equal_versions_of_the_series_pass(version):
    _versions.check_mujoco_pair(mujoco=version, mjx=version)


@pytest.mark.parametrize(
    ("mujoco", "mjx"),
    [
        ("4.0.0", "3.17.0"),  # what a plain `pip install mujoco-mjx` gives
        ("3.17.0", "3.16.0"),
        ("3.17.1", "3.17.0"),
        ("3.16.0", "3.16.0"),  # equal, but of another series
        ("4.0.0", "4.0.0"),
        ("3.170.0", "3.170.0"),  # begins with the same letters, is not the same series
        ("13.17.0", "13.17.0"),
    ],
)
def test_any_other_pair_is_refused_with_both_versions_and_the_cure(mujoco, mjx):
    with pytest.raises(ImportError) as error:
        _versions.check_mujoco_pair(mujoco=mujoco, mjx=mjx)
    message = str(error.value)
    assert f"mujoco {mujoco} and mujoco-mjx {mjx}" in message
    assert "3.17.x" in message
    assert MEND in message


def test_this_environment_passes():
    _versions.check_installed()


def test_installed_versions_are_the_ones_compared(installed):
    installed({"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"})
    with pytest.raises(ImportError, match=r"found mujoco 4\.0\.0 and mujoco-mjx 3\.17\.0"):
        _versions.check_installed()


@pytest.mark.parametrize(
    ("versions", "found"),
    [
        ({"mujoco": "3.17.0"}, "mujoco 3.17.0 and mujoco-mjx (not installed)"),
        ({"mujoco-mjx": "3.17.0"}, "mujoco (not installed) and mujoco-mjx 3.17.0"),
        ({}, "mujoco (not installed) and mujoco-mjx (not installed)"),
    ],
)
def test_a_missing_package_is_named(installed, versions, found):
    installed(versions)
    with pytest.raises(ImportError) as error:
        _versions.check_installed()
    assert found in str(error.value)
    assert MEND in str(error.value)
