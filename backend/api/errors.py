"""Expected errors that only the door knows: who may come in, and how much they may bring."""

from backend.domain.errors import RefusedError, UnglareError


class NotLoggedInError(RefusedError):
    """No valid session or token came with the request. Log in, or send `Authorization: Bearer TOKEN`."""

    status = 401


class TooManyAttemptsError(RefusedError):
    """Too many wrong tokens came from this address. Wait as long as the sentence says."""

    status = 429

    def __init__(self, sentence: str, *, wait_s: float) -> None:
        super().__init__(sentence, details={"wait_s": wait_s})
        self.wait_s = wait_s


class TooLargeError(UnglareError):
    """The body of a request is larger than what this address takes. The sentence names the limit."""

    status = 413
