"""The one exception for input that is refused with a sentence."""


class Problem(ValueError):
    """What was asked cannot be done, and the operator can be told why.

    ``code`` names the sentence (``web/i18n/*.json``, under ``error``), ``values`` fill it.
    Rendering in a language is the server's work; ``str()`` is for developers and logs.
    """

    def __init__(self, code: str, **values: object) -> None:
        self.code = code
        self.values = values
        detail = ", ".join(f"{name}={value!r}" for name, value in values.items())
        super().__init__(f"{code}({detail})")

    def __reduce__(self) -> tuple[object, ...]:
        # The default would call the class with the message; worker processes pickle these.
        return (_rebuild, (type(self), self.code, self.values))


def _rebuild(kind: type[Problem], code: str, values: dict[str, object]) -> Problem:
    return kind(code, **values)
