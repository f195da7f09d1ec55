"""Language models behind HTTP: Ollama's API, and OpenAI's chat completions. Both stream."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from companion.language.tools import MAX_CALLS, ToolCall, arguments_of, calls_of
from companion.settings import LanguageSection
from companion.settings.key_files import KeyFileError, read_secret
from vision.extras import install_command
from vision.redaction import redacted

if TYPE_CHECKING:
    import httpx

MAX_ANSWER_CHARACTERS = 20_000
MAX_ANSWER_BYTES = 8 * 1024 * 1024
"""Of a whole response, with all that a server may write around the characters."""
OLLAMA_CONTEXT_TOKENS = 8192
"""The prompt and the functions take some 5400 tokens with 80 classes; Ollama keeps 4096 by default."""

_LOST = "the connection was lost during the answer"


class LanguageError(RuntimeError):
    """The model cannot be reached or its answer cannot be read. The message is one line without secrets."""

    def __init__(self, text: str) -> None:
        super().__init__(redacted(text))


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a conversation.

    Attributes:
        role: system, user, assistant or tool.
        calls: of the assistant. answers: the call whose result this is, of role tool.
    """

    role: str
    content: str
    calls: tuple[ToolCall, ...] = ()
    answers: ToolCall | None = None


class Endpoint(Protocol):
    """A language model."""

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        """Answer a conversation. `on_text` gets the pieces of text as they come. Raises LanguageError."""


def endpoint_of(url: str, model: str, *, key: str | None = None, timeout_s: float = 120.0) -> Endpoint:
    """The model at an address: OpenAI's format where its path ends with /v1, else Ollama's.

    Raises:
        LanguageError: the extra `language` is not installed.
    """
    try:
        import httpx  # noqa: F401
    except ImportError as error:
        raise LanguageError(f"a language model needs httpx: {install_command('httpx')} ({error})") from None
    kind = OpenAIEndpoint if url.rstrip("/").endswith("/v1") else OllamaEndpoint
    return kind(url.rstrip("/"), model, key, timeout_s)


def endpoint_from(language: LanguageSection) -> Endpoint | None:
    """The language model of the settings; None: sentences are read by patterns. Raises LanguageError."""
    if not language.model:
        return None
    key = None if language.key_file is None else read_api_key(Path(language.key_file))
    return endpoint_of(language.url, language.model, key=key, timeout_s=language.timeout_s)


def read_api_key(path: Path) -> str:
    """Read `language.key_file`. Raises LanguageError."""
    try:
        return read_secret(path, "language.key_file")
    except KeyFileError as error:
        raise LanguageError(str(error)) from error


@dataclass(frozen=True, slots=True)
class OllamaEndpoint:
    """Ollama: a JSON object per line; each has a piece of the text, or whole calls."""

    url: str
    model: str
    key: str | None
    timeout_s: float

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        body = {
            "model": self.model,
            "messages": [_for_ollama(message) for message in messages],
            "tools": tools,
            "stream": True,
            "options": {"num_ctx": OLLAMA_CONTEXT_TOKENS},
        }
        answer = _Answer(on_text)
        async with _lines(self, "/api/chat", body) as lines:
            async for line in lines:
                if not line.strip():
                    continue
                part = _parsed(self, line)
                message = part.get("message") or {}
                answer.add_text(message.get("content") or "")
                for call in calls_of(message.get("tool_calls")):
                    answer.add_call(call)
                answer.whole = answer.whole or bool(part.get("done"))
        return answer.message(self.url)


@dataclass(frozen=True, slots=True)
class OpenAIEndpoint:
    """Any server of OpenAI's chat completions: llama.cpp, vLLM, LM Studio, …"""

    url: str
    model: str
    key: str | None
    timeout_s: float

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        body = {
            "model": self.model,
            "messages": [_for_openai(message) for message in messages],
            "tools": tools,
            "stream": True,
        }
        answer, calls = _Answer(on_text), dict[int, dict[str, Any]]()
        async with _lines(self, "/chat/completions", body) as lines:
            async for line in lines:
                # A server that does not stream answers with one object, in `message` instead of `delta`.
                data = line.removeprefix("data:").strip()
                if not line.startswith(("data:", "{")):
                    continue
                if data == "[DONE]":
                    answer.whole = True
                    break
                for choice in _parsed(self, data)["choices"][:1]:
                    delta = choice.get("delta") or choice.get("message") or {}
                    answer.add_text(delta.get("content") or "")
                    for number, part in enumerate(delta.get("tool_calls") or ()):
                        answer.add_part(calls, part, number)
                    answer.whole = answer.whole or choice.get("finish_reason") is not None
            for call in calls.values():
                answer.add_call(ToolCall(call["name"], arguments_of(call["arguments"]), call["id"]))
        return answer.message(self.url)


class _Answer:
    """An answer as it comes; bounded, since a model may repeat itself without an end."""

    def __init__(self, on_text: Callable[[str], None]) -> None:
        self._on_text = on_text
        self._text, self._calls = "", list[ToolCall]()
        self._characters = 0
        self.whole = False

    def add_text(self, piece: str) -> None:
        self._count(piece)
        self._text += piece
        if piece:
            self._on_text(piece)

    def add_call(self, call: ToolCall) -> None:
        _check_calls(len(self._calls))
        self._calls.append(call)

    def add_part(self, calls: dict[int, dict[str, Any]], part: dict[str, Any], number: int) -> None:
        """Add a piece of a call, by its index; name and arguments come in pieces, or arguments as an object.

        Args:
            number: of the piece among those that came together: its index if it has none.
        """
        index = part.get("index", number)
        if index not in calls:
            _check_calls(len(calls))
        call = calls.setdefault(index, {"id": "", "name": "", "arguments": ""})
        call["id"] = part.get("id") or call["id"]
        function = part.get("function") or {}
        for key in ("name", "arguments"):
            piece = function.get(key) or ""
            if isinstance(piece, str) and isinstance(call[key], str):
                self._count(piece)
                call[key] += piece
            else:
                call[key] = piece

    def _count(self, piece: str) -> None:
        self._characters += len(piece)
        if self._characters > MAX_ANSWER_CHARACTERS:
            raise LanguageError(f"the model's answer has more than {MAX_ANSWER_CHARACTERS} characters")

    def message(self, url: str) -> Message:
        if not self.whole:
            raise LanguageError(f"{url}: {_LOST}")
        return Message("assistant", self._text, tuple(self._calls))


@asynccontextmanager
async def _lines(
    endpoint: OllamaEndpoint | OpenAIEndpoint, path: str, body: dict[str, Any]
) -> AsyncIterator[AsyncIterator[str]]:
    """Post a request; the lines of the answer. Every error of the exchange becomes one line.

    Raises:
        LanguageError: of the server, the connection or the format.
    """
    import httpx

    url = endpoint.url
    try:
        async with (
            asyncio.timeout(endpoint.timeout_s),
            httpx.AsyncClient(**_options(endpoint)) as client,
            client.stream("POST", f"{url}{path}", json=body) as response,
        ):
            if not response.is_success:
                raise LanguageError(_status_text(endpoint, response.status_code, await response.aread()))
            yield response.aiter_lines()
    except (TimeoutError, httpx.TimeoutException):
        raise LanguageError(
            f"{url}: no whole answer within {endpoint.timeout_s:g} s: try a smaller model, or a longer "
            "language.timeout_s"
        ) from None
    except (ConnectionError, httpx.ConnectError):
        is_ollama = isinstance(endpoint, OllamaEndpoint)
        start = "start Ollama with `ollama serve`" if is_ollama else f"start the server at {url}"
        raise LanguageError(f"no language model at {url}: {start}, or set language.url") from None
    except httpx.RequestError:
        raise LanguageError(f"{url}: {_LOST}") from None
    except httpx.InvalidURL as error:
        raise LanguageError(f"language.url: {url!r} is not valid: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise LanguageError(_format_text(endpoint)) from None


def _parsed(endpoint: OllamaEndpoint | OpenAIEndpoint, line: str) -> Any:
    """One object of an answer. Raises LanguageError: it is none, or an error of the server."""
    try:
        part = json.loads(line)
    except ValueError:
        if line.lstrip().startswith("{") and not line.rstrip().endswith("}"):
            raise LanguageError(f"{endpoint.url}: {_LOST}") from None
        found = "an HTML page" if line.lstrip()[:1] == "<" else repr(line[:40])
        raise LanguageError(f"{_format_text(endpoint)}; got {found}") from None
    if isinstance(part, dict) and part.get("error"):
        raise LanguageError(f"{endpoint.url}: the server reports: {_reason(line.encode())}")
    return part


def _format_text(endpoint: OllamaEndpoint | OpenAIEndpoint) -> str:
    kind = "Ollama's" if isinstance(endpoint, OllamaEndpoint) else "OpenAI's"
    return (
        f"{endpoint.url}: the answer is not in the expected format, {kind}; language.url ends with /v1 for "
        "OpenAI's, and has no path for Ollama's"
    )


def _reason(body: bytes) -> str:
    """What a server says in the body of an error."""
    text = body[:10_000].decode("utf-8", "replace").strip()
    if text.startswith("<"):
        return "an HTML page, as of a proxy or of another server: check language.url"
    try:
        said = json.loads(text)
        while isinstance(said, dict):  # OpenAI: {"error": {"message": …}}
            said = next(said[key] for key in ("error", "message", "detail") if key in said)
    except (ValueError, StopIteration, RecursionError):
        said = text
    return " ".join(str(said).split())[:200] or "without a reason"


def _status_text(endpoint: OllamaEndpoint | OpenAIEndpoint, status: int, body: bytes) -> str:
    reason = _reason(body)
    if status == 404 and "model" in reason.lower():
        is_ollama = isinstance(endpoint, OllamaEndpoint)
        advice = f"`ollama pull {endpoint.model}`" if is_ollama else "check language.model"
        return f"{endpoint.url}: model {endpoint.model!r} is not there: {advice} ({reason})"
    if status == 404:
        return f"{_format_text(endpoint)} (404: {reason})"
    if status in (401, 403):
        return f"{endpoint.url}: access denied ({status}): set language.key_file"
    return f"{endpoint.url}: the server answered {status}: {reason}"


def _options(endpoint: OllamaEndpoint | OpenAIEndpoint) -> dict[str, Any]:
    """Options of httpx's client. Without https the certificates, which take 0.1 s, are not loaded."""
    headers = {"Accept-Encoding": "identity"}  # what is unpacked could not be limited
    if endpoint.key is not None:
        headers["Authorization"] = f"Bearer {endpoint.key}"
    return {
        "headers": headers,
        "timeout": endpoint.timeout_s,
        "verify": endpoint.url.startswith("https:"),
        "follow_redirects": False,
        "event_hooks": {"response": [_limit]},
    }


async def _limit(response: httpx.Response) -> None:
    """Limit what is read of a response: a line without an end would be collected whole."""
    import httpx

    if response.headers.get("content-encoding", "identity") != "identity":
        raise LanguageError(f"{response.url}: the answer is compressed, which was not asked for")
    stream = response.stream

    class Limited(httpx.AsyncByteStream):
        async def __aiter__(self) -> AsyncIterator[bytes]:
            received = 0
            async for chunk in cast(httpx.AsyncByteStream, stream):
                received += len(chunk)
                if received > MAX_ANSWER_BYTES:
                    raise LanguageError(f"the model's answer has more than {MAX_ANSWER_BYTES} bytes")
                yield chunk

        async def aclose(self) -> None:
            await cast(httpx.AsyncByteStream, stream).aclose()

    response.stream = Limited()


def _for_ollama(message: Message) -> dict[str, Any]:
    written: dict[str, Any] = {"role": message.role, "content": message.content}
    if message.calls:
        written["tool_calls"] = [
            {"function": {"name": call.name, "arguments": _mapping(call.arguments)}} for call in message.calls
        ]
    if message.answers is not None:
        written["tool_name"] = message.answers.name
    return written


def _for_openai(message: Message) -> dict[str, Any]:
    written: dict[str, Any] = {"role": message.role, "content": message.content}
    if message.calls:
        written["tool_calls"] = [
            {
                "id": call.identifier,
                "type": "function",
                "function": {"name": call.name, "arguments": json.dumps(_mapping(call.arguments))},
            }
            for call in message.calls
        ]
    if message.answers is not None:
        written["tool_call_id"] = message.answers.identifier
    return written


def _mapping(arguments: Any) -> dict[str, Any]:
    """The arguments for the history, where servers require an object."""
    return arguments if isinstance(arguments, dict) else {}


def _check_calls(calls: int) -> None:
    if calls >= MAX_CALLS:
        raise LanguageError(f"the model's answer has more than {MAX_CALLS} calls")
