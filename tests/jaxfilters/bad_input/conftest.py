import jaxtyping
import pytest


@pytest.fixture
def check_rejected():
    """Checks that a call fails with a message that holds some words.

    As users run it: without the run-time type checker of the test suite, whose errors would come first.
    """

    def check(call, words):
        with pytest.raises((ValueError, TypeError)) as caught:
            call()
        missing = [word for word in words if word not in str(caught.value)]
        assert not missing, f"{missing} not in: {caught.value}"

    jaxtyping.config.update("jaxtyping_disable", True)
    yield check
    jaxtyping.config.update("jaxtyping_disable", False)
