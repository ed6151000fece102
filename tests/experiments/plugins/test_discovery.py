"""Names of methods: ours, other people's, and those of installed packages."""

import importlib
import sys

import pytest

from experiments.plugins import discovery
from experiments.plugins.discovery import (
    Kind,
    KnownMethod,
    find_method,
    fingerprint,
    known_methods,
    make_method,
)
from experiments.plugins.process_main import MethodRunner


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on the path into which packages can be put."""
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    monkeypatch.undo()
    forget()


def forget():
    discovery.declared.cache_clear()
    discovery.fingerprint.cache_clear()
    importlib.invalidate_caches()


def install(site, package, points, version="1.0"):
    info = site / f"{package}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[mapfusion.aligners]\n{points}\n")
    forget()


def test_a_declared_aligner_is_known_by_name_without_being_imported(site):
    (site / "elsewhere.py").write_text("raise SystemExit('imported')")
    install(site, "some_package", "theirs = elsewhere:Outer.Method [fast]")
    method = find_method("theirs")
    assert method == KnownMethod(
        "theirs", Kind.PLUG_IN, "elsewhere:Outer.Method", "some_package", "elsewhere"
    )
    assert method.version == "1.0"
    assert method.absence == ""
    assert "elsewhere" not in sys.modules
    assert list(known_methods())[:4] == ["ransac", "svd", "icp", "impicp"]
    with pytest.raises(ValueError, match=r"unknown aligner 'nobody', known are ransac.*, theirs$"):
        find_method("nobody")


def test_it_is_made_with_its_parameters(site):
    code = "class Outer:\n  class Method:\n    def __init__(self, a): self.a = a\n"
    (site / "made_elsewhere.py").write_text(code)
    install(site, "some_package", "theirs = made_elsewhere:Outer.Method")
    made = make_method("theirs", a=3)
    assert getattr(made, "a") == 3  # noqa: B009
    with pytest.raises(ValueError, match=r"parameters: theirs: .*'b'"):
        make_method("theirs", b=3)


def test_a_former_import_is_told_with_the_new_module(site):
    code = "\n\nfrom mapfusion.align.rigid import fit_rigid\n"
    (site / "with_former_import.py").write_text(code)
    install(site, "some_package", "theirs = with_former_import:Method")
    assert MethodRunner().answer("make", "theirs", {}) == {
        "error": "raised ModuleNotFoundError: No module named 'mapfusion.align.rigid'; "
        "mapfusion.align.rigid is now mapfusion.align.rigid_motion: change the import "
        "(with_former_import.py:3)"
    }


def test_our_own_names_stay_ours(site):
    install(site, "some_package", "ransac = elsewhere:Ransac\nopencv = elsewhere:OpenCv")
    assert find_method("ransac").kind is Kind.BUILT_IN
    assert find_method("opencv").kind is Kind.PEER
    assert type(make_method("ransac")).__module__ == "mapfusion.align.ransac"
    assert discovery.name_clashes()["ransac"] == (
        "aligner ransac: mapfusion's own is used, the one that some_package declares under the "
        "same name is not"
    )


def test_a_name_of_two_packages_is_nobodys(site):
    install(site, "first", "theirs = elsewhere:Method")
    install(site, "second", "theirs = elsewhere:Method")
    assert "theirs" not in known_methods()
    line = "aligner theirs: declared by first and by second; uninstall all but one"
    with pytest.raises(ValueError, match=line):
        find_method("theirs")


def test_no_clash_without_a_second_claim(site):
    install(site, "package", "theirs = m:A")
    assert discovery.name_clashes() == {}


@pytest.mark.parametrize("points", ["theirs = nothing here!", "theirs = no.such.module:Method"])
def test_broken_metadata_break_nothing_else(site, points):
    install(site, "broken", points)
    assert find_method("ransac").kind is Kind.BUILT_IN
    assert find_method("theirs").origin()["files"] == ""
    with pytest.raises((ImportError, AttributeError)):
        make_method("theirs")


def test_origin_changes_with_the_package(site):
    package = site / "grown"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "method.py").write_text("a = 1")
    install(site, "grown_package", "theirs = grown.method:Method")
    origins = [find_method("theirs").origin()]
    for file, text in (("method.py", "a = 2"), ("helper.py", ""), ("core.so", "1")):
        (package / file).write_text(text)
        fingerprint.cache_clear()
        origins.append(find_method("theirs").origin())
    (package / "notes.txt").write_text("of no matter")
    fingerprint.cache_clear()
    assert find_method("theirs").origin() == origins[-1]
    (site / "grown_package-1.0.dist-info").rename(site / "grown_package-1.1.dist-info")
    metadata = site / "grown_package-1.1.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.0", "1.1"))
    forget()
    origins.append(find_method("theirs").origin())
    assert len({tuple(sorted(origin.items())) for origin in origins}) == len(origins)


def test_ours_depend_on_nothing_but_our_source():
    assert find_method("ransac").origin() == {"target": "mapfusion.align.ransac:Ransac"}
    assert find_method("opencv").origin()["version"]


def test_an_absent_package_is_told_with_what_installs_it():
    method = KnownMethod("far", Kind.PEER, "m:Far", "far-package", "no_such_module_far")
    assert method.absence == (
        "the package far-package is not installed; pip install 'mapfusion-bench[peers]' installs it"
    )
    assert (method.version, method.origin()["files"]) == ("", "")
