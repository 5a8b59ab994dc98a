import os

import pytest
from joblib.externals.loky import get_reusable_executor


@pytest.fixture(scope="session")
def log(tmp_path_factory):
    """Where the toy stages count their executions: one folder for all tests, as worker processes live longer than one."""
    path = tmp_path_factory.mktemp("log")
    os.environ["TOY_LOG"] = str(path)
    get_reusable_executor().shutdown(wait=True)  # workers of other tests do not know the variable
    yield path
    del os.environ["TOY_LOG"]


@pytest.fixture
def folder(tmp_path, log):
    """A folder with two inputs a.txt and b.txt; nothing counted yet."""
    (tmp_path / "a.txt").write_text("1 2 3")
    (tmp_path / "b.txt").write_text("4 5")
    for path in log.iterdir():
        path.unlink()
    return tmp_path
