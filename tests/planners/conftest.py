"""Fixtures of the tests of planners."""

import ssl

import pytest
from fake_server import serving

import lw_torchrl as lw


@pytest.fixture(autouse=True)
def _no_account(monkeypatch):
    """Hide the keys, addresses and proxies of this machine."""
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "*")


@pytest.fixture(scope="session")
def certificates():
    """Load this machine's certificates once, which takes 50 ms."""
    return ssl.create_default_context()


@pytest.fixture
def ask(tmp_path, monkeypatch, certificates):
    """Ask a server for plans, and again at once after a failure; replies are cached in the test's folder."""
    monkeypatch.setattr("ssl.create_default_context", lambda: certificates)
    monkeypatch.setattr("openai._base_client.INITIAL_RETRY_DELAY", 0.001)

    def ask(server, tasks="MT10", *, format="chain_py", attempts=1, out=None, **options):
        options = {"cache": tmp_path / "kept", "retries": 1, "timeout": 20.0, **options}
        with serving(server) as address:
            planner = lw.OpenAIPlanner("a/model", base_url=address, **options)
            planner.address = "http://fake/v1"  # the cache's key has the address, and each port is another
            return planner.plans(tasks, format=format, attempts=attempts, out=out, progress=False)

    return ask
