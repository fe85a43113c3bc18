"""What the tests of recordings share."""

import pytest

from limber.store import Branch


@pytest.fixture
def bare_folder(tmp_path):
    """Without a mesh: the hand-made pull is of no branch."""
    return Branch.create(tmp_path / "bare.branch").folder
