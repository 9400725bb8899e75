"""Folders of cached code: what others may write in is found."""

import os

import pytest

from equipoise.private_folder import make_private_folder, writable_by_others

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows has no such permissions")


@pytest.fixture
def folder(tmp_path):
    make_private_folder(tmp_path / "a" / "b")
    (tmp_path / "a" / "b" / "index").write_bytes(b"")
    return tmp_path / "a" / "b"


def test_folders_are_made_for_their_owner_alone(folder, tmp_path):
    for made in (folder, folder.parent):
        assert made.stat().st_mode & 0o777 == 0o700
    make_private_folder(folder)
    (tmp_path / "file").touch()
    with pytest.raises(OSError):  # noqa: PT011
        make_private_folder(tmp_path / "file" / "c")


def test_a_folder_of_the_owner_alone_is_used(folder):
    assert writable_by_others(folder) == ""
    (folder / "index").chmod(0o666)  # nobody else gets as far
    assert writable_by_others(folder) == ""


@pytest.mark.parametrize("place", [".", "..", "index"])
@pytest.mark.parametrize("mode", [0o777, 0o757])
def test_what_others_may_write_to_is_refused(folder, place, mode):
    folder.chmod(0o755)
    (folder / place).chmod(mode)
    assert "others may write to" in writable_by_others(folder)


def test_a_folder_of_a_group_with_other_members_is_refused(folder, monkeypatch):
    folder.chmod(0o770)
    monkeypatch.setattr("equipoise.private_folder._is_own_group", lambda _: False)
    assert "others may write to" in writable_by_others(folder)
    monkeypatch.setattr("equipoise.private_folder._is_own_group", lambda _: True)
    assert writable_by_others(folder) == ""


def test_above_a_folder_the_sticky_bit_protects_it_within_it_does_not(folder):
    folder.parent.chmod(0o1777)
    assert writable_by_others(folder) == ""
    folder.chmod(0o1777)
    assert "others may write to" in writable_by_others(folder)


def test_links_are_followed_and_looked_at(folder, tmp_path):
    open_to_all = tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    (open_to_all / "link").symlink_to(folder)
    assert "open" in writable_by_others(open_to_all / "link")
    (tmp_path / "link").symlink_to("a/../a/b")
    assert writable_by_others(tmp_path / "link") == ""
    (tmp_path / "to_open").symlink_to(open_to_all)
    assert "open" in writable_by_others(tmp_path / "to_open")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(OSError, match="too many"):
        writable_by_others(tmp_path / "loop")
    (folder / "index2").symlink_to(tmp_path / "file")
    assert "is a symbolic link" in writable_by_others(folder)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root")
@pytest.mark.parametrize("place", [".", "..", "index"])
def test_what_belongs_to_another_user_is_refused(folder, place):
    os.chown(folder / place, 12345, 12345)
    assert "belongs to another user" in writable_by_others(folder)
