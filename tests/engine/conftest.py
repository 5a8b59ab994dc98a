import pytest


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with two inputs a.txt and b.txt, and the log in which the toy stages count their executions."""
    (tmp_path / "a.txt").write_text("1 2 3")
    (tmp_path / "b.txt").write_text("4 5")
    (tmp_path / "log").mkdir()
    monkeypatch.setenv("TOY_LOG", str(tmp_path / "log"))
    return tmp_path
