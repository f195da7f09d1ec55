"""Language models behind HTTP: Ollama's API, and OpenAI's chat completions. Both stream."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from companion.key_files import KeyFileError, check_private
from companion.language.tools import MAX_CALLS, ToolCall
from companion.settings import LanguageSection
from vision.extras import install_command
from vision.file_kinds import kind_of_bytes
from vision.redaction import redacted
from vision.text_file import decode_text

if TYPE_CHECKING:
    import httpx

MAX_ANSWER_CHARACTERS = 20_000
MAX_ANSWER_BYTES = 8 * 1024 * 1024
"""Of a whole response, with all that a server may write around the characters."""
OLLAMA_CONTEXT_TOKENS = 8192
"""The prompt and the functions take some 5400 tokens with 80 classes; Ollama keeps 4096 by default."""


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
        LanguageError: the extra `llm` is not installed.
    """
    try:
        import ollama  # noqa: F401
    except ImportError as error:
        raise LanguageError(f"a language model needs ollama: {install_command('ollama')} ({error})") from None
    kind = OpenAIEndpoint if url.rstrip("/").endswith("/v1") else OllamaEndpoint
    return kind(url.rstrip("/"), model, key, timeout_s)


def endpoint_from(language: LanguageSection) -> Endpoint | None:
    """The language model of the settings; None: sentences are read by patterns. Raises LanguageError."""
    if not language.model:
        return None
    key = None if language.key_file is None else read_api_key(Path(language.key_file))
    return endpoint_of(language.url, language.model, key=key, timeout_s=language.timeout_s)


def read_api_key(path: Path) -> str:
    """Read `language.key_file`, a text that only its owner can read. Raises LanguageError."""
    try:
        check_private(path, path.stat())
        content = path.read_bytes()
        if (kind := kind_of_bytes(content)) is not None:
            raise LanguageError(f"language.key_file {path}: {kind}")
        return decode_text(content).strip()
    except KeyFileError as error:
        raise LanguageError(f"language.key_file {error}") from None
    except OSError as error:
        raise LanguageError(f"language.key_file {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise LanguageError(f"language.key_file {path}: expected a line of text") from None


@dataclass(frozen=True, slots=True)
class OllamaEndpoint:
    """Ollama, by its own client."""

    url: str
    model: str
    key: str | None
    timeout_s: float

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        import ollama

        client = ollama.AsyncClient(host=self.url, **_options(self))
        written = [_for_ollama(message) for message in messages]
        answer = _Answer(on_text)
        async with _readable(self, f"`ollama pull {self.model}`"):
            async for part in await client.chat(
                self.model, written, tools=tools, stream=True, options={"num_ctx": OLLAMA_CONTEXT_TOKENS}
            ):
                answer.add_text(part.message.content or "")
                for call in part.message.tool_calls or ():
                    answer.add_call(ToolCall(call.function.name, dict(call.function.arguments)))
                answer.whole = answer.whole or bool(part.done)
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
        import httpx

        body = {
            "model": self.model,
            "messages": [_for_openai(message) for message in messages],
            "tools": tools,
            "stream": True,
        }
        answer, calls = _Answer(on_text), dict[int, dict[str, str]]()
        async with (
            _readable(self, "check language.model and language.url"),
            httpx.AsyncClient(**_options(self)) as client,
            client.stream("POST", f"{self.url}/chat/completions", json=body) as response,
        ):
            if response.is_error:
                await response.aread()
                response.raise_for_status()
            async for line in response.aiter_lines():
                data = line.removeprefix("data:").strip()
                if not line.startswith("data:"):
                    continue
                if data == "[DONE]":
                    answer.whole = True
                    break
                for choice in json.loads(data)["choices"][:1]:
                    delta = choice.get("delta") or {}
                    answer.add_text(delta.get("content") or "")
                    for part in delta.get("tool_calls") or ():
                        answer.add_part(calls, part)
                    answer.whole = answer.whole or choice.get("finish_reason") is not None
            for call in calls.values():
                answer.add_call(ToolCall(call["name"], _object(call["arguments"]), call["id"]))
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

    def add_part(self, calls: dict[int, dict[str, str]], part: dict[str, Any]) -> None:
        """Add a piece of a call, by its index; name and arguments come in pieces."""
        index = part.get("index", 0)
        if index not in calls:
            _check_calls(len(calls))
        call = calls.setdefault(index, {"id": "", "name": "", "arguments": ""})
        call["id"] = part.get("id") or call["id"]
        function = part.get("function") or {}
        for key in ("name", "arguments"):
            piece = function.get(key) or ""
            self._count(piece)
            call[key] += piece

    def _count(self, piece: str) -> None:
        self._characters += len(piece)
        if self._characters > MAX_ANSWER_CHARACTERS:
            raise LanguageError(f"the model's answer has more than {MAX_ANSWER_CHARACTERS} characters")

    def message(self, url: str) -> Message:
        if not self.whole:
            raise LanguageError(f"{url}: the connection was lost during the answer")
        return Message("assistant", self._text, tuple(self._calls))


@asynccontextmanager
async def _readable(endpoint: OllamaEndpoint | OpenAIEndpoint, advice: str) -> AsyncIterator[None]:
    """Turn every error of an exchange into one line."""
    import httpx
    import ollama

    url = endpoint.url
    try:
        async with asyncio.timeout(endpoint.timeout_s):
            yield
    except (TimeoutError, httpx.TimeoutException):
        raise LanguageError(
            f"{url}: no whole answer within {endpoint.timeout_s:g} s: try a smaller model, or a longer "
            "language.timeout_s"
        ) from None
    except (ConnectionError, httpx.ConnectError):
        is_ollama = isinstance(endpoint, OllamaEndpoint)
        start = "start Ollama with `ollama serve`" if is_ollama else f"start the server at {url}"
        raise LanguageError(f"no language model at {url}: {start}, or set language.url") from None
    except httpx.TransportError as error:
        raise LanguageError(f"{url}: the connection was lost during the answer: {error}") from None
    except httpx.InvalidURL as error:
        raise LanguageError(f"language.url: {url!r} is not valid: {error}") from None
    except (ollama.ResponseError, httpx.HTTPStatusError) as error:
        raise LanguageError(_status_text(error, endpoint, advice)) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        first = str(error).splitlines()[0] if str(error) else ""
        raise LanguageError(
            f"{url}: the answer is not in the expected format ({type(error).__name__}: {first[:120]}); "
            "language.url ends with /v1 for OpenAI's format"
        ) from None


def _status_text(error: Any, endpoint: OllamaEndpoint | OpenAIEndpoint, advice: str) -> str:
    response = getattr(error, "response", None)
    status = error.status_code if response is None else response.status_code
    reason = " ".join(str(error.error if response is None else response.text).split())[:200]
    if status == 404:
        return f"{endpoint.url}: model {endpoint.model!r} is not there: {advice} ({reason})"
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


def _object(text: str) -> Any:
    """The arguments of a call; the text itself where it is not JSON, which `read_call` refuses."""
    try:
        return json.loads(text or "{}")
    except (ValueError, RecursionError):
        return text
