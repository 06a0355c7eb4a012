"""What tests of planners share."""

import pytest


@pytest.fixture
def no_account(monkeypatch):
    """No key, address or proxy of this machine reaches a planner."""
    for name in ("OPENAI_API_KEY", "OPENAI_BASE_URL", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "*")
