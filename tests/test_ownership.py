"""Cached programs run with their user's rights: only files that no other user could have written are read, and only the
package's own are removed."""

import os
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import pytest

from jaxrock.command_line.main import main
from jaxrock.compiler.cache import enable, ownership, store
from jaxrock.compiler.cache.enable import keep_compiled

NAME, OTHER = "jaxrock_" + 20 * "a", 40 * "b"
OF_JAX = f"jit_f-{64 * 'c'}-cache"
STRANGER = 65534  # the user `nobody`

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has no owners of this kind")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Return a cache folder with one program in it, with all warnings still to come."""
    ownership.warn_once.cache_clear()
    (tmp_path / "of the user").mkdir()
    monkeypatch.setenv("JAXROCK_CACHE", str(tmp_path / "of the user"))
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) == b"content"
    return store.folder()


@pytest.fixture
def give_away(monkeypatch):
    """Give a path to another user: root changes its owner, other users pretend so."""

    def given(path):
        if os.geteuid() == 0:
            return os.chown(path, STRANGER, STRANGER, follow_symlinks=False)
        number, told = os.lstat(path).st_ino, {"fstat": os.fstat, "lstat": os.lstat, "stat": os.stat}

        def of_another(ask):
            def asked(*args, **kwargs):
                about = ask(*args, **kwargs)
                return os.stat_result([*about[:4], STRANGER, *about[5:]]) if about.st_ino == number else about

            return asked

        for name, ask in told.items():
            monkeypatch.setattr(os, name, of_another(ask))

    return given


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def refused(message):
    """Check that nothing is read or written, and that one warning says why."""
    with pytest.warns(RuntimeWarning, match=message) as said:
        assert store.read("machine", NAME) is None
        store.write("machine", OTHER, b"content")
        assert store.read("machine", OTHER) is None
    assert len(said) == 1 and "Let JAXROCK_CACHE name a folder of yours" in str(said[0].message)
    return True


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o022, 0o077])
def test_new_folders_and_files_are_private(tmp_path, monkeypatch, umask):
    monkeypatch.setenv("JAXROCK_CACHE", str(tmp_path / "new" / "kept"))
    before = os.umask(umask)
    try:
        store.write("machine", NAME, b"content")
    finally:
        os.umask(before)
    place = store.folder()
    assert [mode(each) for each in (place.parent.parent, place.parent, place, place / "machine")] == 4 * [0o700]
    assert mode(place / "machine" / NAME) == 0o600


@pytest.mark.parametrize("loose", [0o755, 0o775, 0o777])
def test_a_folder_of_the_users_is_closed_to_others(place, loose):
    for each in (place, place / "machine"):
        each.chmod(loose)
    assert store.read("machine", NAME) == b"content"
    assert mode(place) == mode(place / "machine") == 0o700


@pytest.mark.parametrize("which", ["whole", "machine"])
def test_a_folder_of_another_user_is_not_used(place, give_away, which):
    give_away(place if which == "whole" else place / "machine")
    assert refused("belongs to another user")


def test_a_file_of_another_user_is_not_read(place, give_away):
    """The file is neither replaced nor removed, and another can be cached beside it."""
    give_away(place / "machine" / NAME)
    assert store.read("machine", NAME) is None
    store.write("machine", NAME, b"another")
    assert store.read("machine", NAME) is None and (place / "machine" / NAME).read_bytes().endswith(b"content")
    store.write("machine", OTHER, b"content")
    assert store.read("machine", OTHER) == b"content"


@pytest.mark.parametrize("loose", [0o620, 0o602, 0o666])
def test_a_file_that_others_could_write_is_made_anew(place, loose):
    path = place / "machine" / NAME
    path.chmod(loose)
    assert store.read("machine", NAME) is None and not path.exists()
    store.write("machine", NAME, b"anew")
    assert store.read("machine", NAME) == b"anew"


def test_a_file_that_is_a_link_is_not_read(place, tmp_path):
    """A link is not read, nor a pipe: opening it would wait."""
    path = place / "machine" / NAME
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    os.mkfifo(place / "machine" / OTHER)
    for name in (NAME, OTHER):
        assert store.read("machine", name) is None
        store.write("machine", name, b"content")
        assert store.read("machine", name) is None
    assert path.is_symlink() and (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("bits, good", [(0o777, False), (0o1777, True), (0o755, True), (0o1775, True)])
def test_a_parent_writable_by_others(place, bits, good):
    """Others could rename the folder, and put another in its place, except in a sticky folder such as /tmp."""
    place.parent.chmod(bits)
    assert store.read("machine", NAME) == b"content" if good else refused("others may write in .*of the user")


@pytest.mark.parametrize(
    "members, name, users, good",
    [
        ([], "me", {}, True),
        (["me"], "me", {}, True),
        (["me", "you"], "me", {}, False),
        ([], "me", {"me": 1}, False),
        ([], "users", {"me": 0}, True),
        ([], "users", {"me": 0, "you": 0}, False),
        ([], "users", {}, False),
    ],
    ids=["by name", "a member", "two members", "not the first", "alone in it", "the first of two", "not listed"],
)
def test_a_parent_that_a_group_may_write(place, monkeypatch, members, name, users, good):
    """A parent is safe where no other user belongs to the group; many systems make folders so.

    `users` gives the first group of every user that the system knows; those are no members by name.
    """
    import grp
    import pwd
    from types import SimpleNamespace

    group = place.parent.stat().st_gid
    known = [SimpleNamespace(pw_name=user, pw_gid=group + off) for user, off in users.items()]
    me = next((user for user in known if user.pw_name == "me"), SimpleNamespace(pw_name="me", pw_gid=group))
    monkeypatch.setattr(pwd, "getpwuid", lambda _: me)
    monkeypatch.setattr(pwd, "getpwall", lambda: known)
    monkeypatch.setattr(grp, "getgrgid", lambda _: SimpleNamespace(gr_mem=members, gr_name=name))
    place.parent.chmod(0o775)
    assert store.read("machine", NAME) == b"content" if good else refused("others may write in .*of the user")


def test_nothing_is_kept_in_what_is_no_folder(monkeypatch):
    """There is nothing to warn of, although all users may write in it."""
    monkeypatch.setenv("JAXROCK_CACHE", os.devnull)
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) is None


def test_a_parent_of_another_user(place, give_away):
    give_away(place.parent)
    assert refused("of the user, on the way to them, belongs to another user")


def test_owners_that_a_container_does_not_know(place, give_away, monkeypatch):
    """In a user namespace the parents may seem to belong to `nobody`; the folder itself may not."""
    monkeypatch.setattr(ownership, "_is_mapped", lambda: True)
    give_away(place.parent)
    assert store.read("machine", NAME) == b"content"
    give_away(place)
    assert refused("belongs to another user")


@pytest.mark.parametrize(
    "told, mapped", [("0 0 4294967295\n", False), ("0 1000 1\n1 100000 65536\n", True), (None, False)]
)
def test_containers_are_recognised_by_their_user_map(monkeypatch, told, mapped):
    def read(path):
        if told is None:
            raise FileNotFoundError
        return told

    monkeypatch.setattr(Path, "read_text", read)
    assert ownership._is_mapped.__wrapped__() == mapped


@pytest.mark.parametrize("whose", ["the user's", "another's"])
@pytest.mark.parametrize("linked", ["the folder", "its parent"])
def test_a_link_to_a_larger_disk(place, tmp_path, give_away, whose, linked):
    """A link of the user's own is followed, to a folder within its target; a link of another user is not."""
    link = place if linked == "the folder" else place.parent
    link.rename(tmp_path / "kept before")
    (tmp_path / "disk").mkdir()
    link.symlink_to(tmp_path / "disk")
    if whose == "another's":
        give_away(link)
        assert refused("on the way to them, belongs to another user")
        assert not list((tmp_path / "disk").iterdir())
        return
    store.write("machine", NAME, b"content")
    assert store.read("machine", NAME) == b"content"
    assert [path.name for path in (tmp_path / "disk").iterdir()] == ["jaxrock-compiled"]


def test_a_link_within_the_folder_is_not_followed(place, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (place / "machine").rename(tmp_path / "kept before")
    (place / "machine").symlink_to(tmp_path / "elsewhere")
    assert refused("machine is a link") and not list((tmp_path / "elsewhere").iterdir())


USERS = (
    ".bashrc",
    "thesis.tex",
    "results.h5",
    "machine/mine.o",
    "machine/deeper/file",
    f"machine/{OTHER}",
    f"lowered/.{NAME}.{32 * '0'}.partial",
    "xla/my-cache",
)


@pytest.mark.parametrize("linked", [True, False])
def test_only_what_the_package_made_is_removed(place, tmp_path, capsys, linked):
    """A folder, which is a link to a home, also holds large old files of the user's; some have names of the
    package's."""
    home = tmp_path / "home" if linked else place
    if linked:
        place.rename(tmp_path / "kept before")
        place.symlink_to(home)
    for name in USERS:
        file = home / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("years of work")
        os.utime(file, (1e9, 1e9))
    with (home / "results.h5").open("ab") as file:
        file.truncate(2 * store.LARGEST)  # a sparse file
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("years of work")
    store.write("machine", NAME, b"content")
    (store.folder() / "machine" / ("jaxrock_" + 20 * "d")).symlink_to(elsewhere)
    store.prune(0)
    assert not store.files()
    store.write("machine", NAME, b"content")
    assert main(["cache", "--clear"]) == 0 and "1 compiled programs" in capsys.readouterr().out
    for name in USERS:
        with (home / name).open() as file:
            assert file.read(13) == "years of work"
    assert elsewhere.exists() and not store.files()


def test_what_was_never_finished_goes_after_a_while(place):
    for age, name in ((0, NAME), (1000, OTHER)):
        unfinished = place / "machine" / f".{name}.{32 * '0'}.partial"
        unfinished.write_bytes(store._MARK + b"half")
        when = unfinished.stat().st_mtime - age
        os.utime(unfinished, (when, when))
    store.prune(store.LARGEST)
    assert {path.name for path in store.files()} == {NAME, f".{NAME}.{32 * '0'}.partial"}


def test_files_without_a_mark_are_known_by_their_digest(place):
    path = place / "machine" / NAME
    path.write_bytes(path.read_bytes().removeprefix(store._MARK))
    assert store.read("machine", NAME) == b"content" and store.files() == [path]
    store.clear()
    assert not path.exists()


@pytest.fixture
def unset(monkeypatch):
    """Leave JAX without a cache, and return the settings that the package makes."""
    told = {}
    monkeypatch.setattr(enable, "setting", lambda _: None)
    monkeypatch.setattr(enable, "compile_quickly", lambda: None)
    monkeypatch.setattr(jax.config, "update", told.__setitem__)
    return told


def test_jax_keeps_its_programs_in_a_private_folder(place, unset):
    """JAX's own folder lies beside those of other releases of JAX."""
    (place / store.OF_JAX).mkdir()
    (place / store.OF_JAX / "of another release").touch()
    keep_compiled()
    assert unset["jax_compilation_cache_dir"] == str(place / store.OF_JAX) and mode(place / store.OF_JAX) == 0o700


@pytest.mark.parametrize(
    "planted", ["a file of another user", "a link", "a file of another name", "its folder is a link"]
)
def test_jax_runs_nothing_of_others(place, unset, tmp_path, give_away, planted):
    """JAX reads any file in its folder, follows links, and deletes files that have its names."""
    there = place / store.OF_JAX
    if planted == "its folder is a link":
        there.symlink_to(tmp_path)
    else:
        there.mkdir()
        file = there / (OF_JAX if planted != "a file of another name" else "my-cache")
        file.touch() if planted != "a link" else file.symlink_to(tmp_path)
        if planted == "a file of another user":
            give_away(file)
    with pytest.warns(RuntimeWarning, match="are not kept between sessions"):
        keep_compiled()
    assert not unset


@pytest.mark.parametrize("loose, left", [(0o755, True), (0o775, False), (0o777, False)])
def test_files_of_jax_that_others_could_write_are_removed(place, unset, loose, left):
    there = place / store.OF_JAX
    there.mkdir()
    (there / OF_JAX).touch()
    there.chmod(loose)
    keep_compiled()
    assert (there / OF_JAX).exists() == left and mode(there) == 0o700 and unset


def test_names_of_jax_are_those_that_it_gives(tmp_path):
    """Names follow the installed release of JAX, which leaves no other files."""
    code = """
import jax, os, sys, jaxrock as rk
from jaxrock.compiler.cache import store
rk.keep_compiled()
jax.jit(lambda x: 2 * x)(1.0)
made, others = store.of_jax()
assert made and not others, others
assert set(store.files()) == {path for path in store.folder().rglob("*") if path.is_file()}
store.clear()
assert not list(store.folder().iterdir())
"""
    environment = os.environ | {"JAXROCK_CACHE": str(tmp_path / "kept"), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_computation_goes_on_where_nothing_may_be_kept(place, give_away):
    """The answer is the same, and the warning is one."""
    import jaxrock as rk

    give_away(place)
    jax.clear_caches()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        outcome = rk.outcome(rk.Block(0.2, 2.0), rk.SinePulse(0.41, 0.77), rk.Linear(), engine=rk.Series(order=4))
        assert float(outcome.max_rotation) > 0
    assert sum("are not kept between sessions" in str(each.message) for each in said) == 1
