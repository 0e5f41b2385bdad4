import importlib
import tomllib
from importlib.metadata import version
from pathlib import Path

import jaxfilters

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PYPROJECT["tool"]["setuptools"]


def folders_with_code():
    """Import names of all folders with Python files, by the mapping of folders to packages."""
    names = set()
    for package, folder in SETUPTOOLS["package-dir"].items():
        for path in (ROOT / folder).rglob("*.py"):
            names.add(".".join([package, *path.parent.relative_to(ROOT / folder).parts]))
    return names


def folder_of(package):
    folders = SETUPTOOLS["package-dir"]
    mapped = max((name for name in folders if f"{package}.".startswith(f"{name}.")), key=len)
    return ROOT / folders[mapped] / package.removeprefix(mapped).replace(".", "/").strip("/")


def test_every_folder_with_code_is_listed_as_a_package():
    """A folder that is not listed works in a checkout and is missing from the wheel."""
    assert set(SETUPTOOLS["packages"]) == folders_with_code()
    assert len(SETUPTOOLS["packages"]) == len(set(SETUPTOOLS["packages"]))


def test_every_package_has_an_init():
    for name in SETUPTOOLS["packages"]:
        assert (folder_of(name) / "__init__.py").exists(), name


def test_data_files_that_are_promised_exist():
    for package, patterns in SETUPTOOLS["package-data"].items():
        folder = folder_of(package)
        for pattern in patterns:
            assert list(folder.glob(pattern)), f"{package}: {pattern}"


def test_the_version_is_in_the_changelog_and_is_the_installed_one():
    assert f"## [{jaxfilters.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    assert version("jaxfilters") == jaxfilters.__version__


def test_the_licence_is_the_one_that_is_stated():
    assert PYPROJECT["project"]["license"] == "Apache-2.0"
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_licences_of_what_is_derived_from_others_travel_with_the_package():
    """The MIT License asks for its copyright notice and its permission notice."""
    assert PYPROJECT["project"]["license-files"] == ["LICENSE", "NOTICE"]
    text = (ROOT / "NOTICE").read_text()
    assert "Copyright (c) 2020 USC Institute for Creative Technologies" in text
    assert "Permission is hereby granted, free of charge" in text
    assert (ROOT / "trackers" / "io" / "detector_errors.npz").exists()
    assert "trackers/io/detector_errors.npz" in text


def test_extras_repeat_no_requirement_of_the_library():
    core = {requirement.split(">")[0] for requirement in PYPROJECT["project"]["dependencies"]}
    for extra in PYPROJECT["project"]["optional-dependencies"].values():
        assert not core & {requirement.split(">")[0] for requirement in extra}


def test_the_folders_are_one_namespace():
    for name in ("models", "trackers", "benchmarks"):
        module = importlib.import_module(f"jaxfilters.{name}")
        assert Path(module.__file__).parent.name == name
