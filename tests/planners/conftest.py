"""Fixtures of the tests of planners."""

import pytest
from fake_server import serving

import lw_torchrl as lw


@pytest.fixture(autouse=True)
def _no_account(monkeypatch):
    """Hide the keys, addresses and proxies of this machine."""
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "*")


@pytest.fixture
def ask(tmp_path):
    """Ask a server for plans; replies are cached in the test's folder."""

    def ask(server, tasks="MT10", *, format="chain_py", attempts=1, out=None, **options):
        options = {"cache": tmp_path / "kept", "retries": 1, "timeout": 20.0, **options}
        with serving(server) as address:
            planner = lw.OpenAIPlanner("a/model", base_url=address, **options)
            planner.address = "http://fake/v1"  # the cache's key has the address, and each port is another
            return planner.plans(tasks, format=format, attempts=attempts, out=out, progress=False)

    return ask
