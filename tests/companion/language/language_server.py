"""An HTTP server on loopback that answers as Ollama and as OpenAI's chat completions do, from a script."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

Call = tuple[str, dict[str, Any]]


@dataclass
class Script:
    """Answers by number of the request, the last one for all further ones.

    Attributes:
        requests: (path, body) of each. headers: of the newest.
    """

    answers: Sequence[bytes]
    requests: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    headers: dict[str, str] = field(default_factory=dict)
    url: str = ""

    def next(self) -> bytes:
        return self.answers[min(len(self.requests), len(self.answers)) - 1]


def response(chunks: Sequence[bytes], kind: str, *, status: str = "200 OK", cut: bool = False) -> bytes:
    """A chunked response. `cut`: the connection is lost before its end."""
    head = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
    body = b"".join(f"{len(chunk):x}\r\n".encode() + chunk + b"\r\n" for chunk in chunks)
    return head + body + (b"" if cut else b"0\r\n\r\n")


def ollama(text: str = "", calls: Sequence[Call] = (), *, cut: bool = False) -> bytes:
    """One answer of `/api/chat`: a JSON object per line; a call comes whole, in one object."""
    stamp = {"model": "small", "created_at": "2025-08-01T12:00:00.123456789Z"}
    parts: list[dict[str, Any]] = [
        {**stamp, "message": {"role": "assistant", "content": piece}, "done": False}
        for piece in text.split(" ")
        if piece
    ]
    parts += [
        {
            **stamp,
            "message": {
                "role": "assistant",
                "content": "",
                "tool_calls": [{"function": {"name": name, "arguments": arguments}}],
            },
            "done": False,
        }
        for name, arguments in calls
    ]
    if not cut:
        end = {"done": True, "done_reason": "stop", "total_duration": 12, "eval_count": 3}
        parts.append({**stamp, "message": {"role": "assistant", "content": ""}, **end})
    lines = [json.dumps(part).encode() + b"\n" for part in parts]
    return response(lines, "application/x-ndjson", cut=cut)


def openai(text: str = "", calls: Sequence[tuple[str, str]] = (), *, cut: bool = False) -> bytes:
    """One answer of `/chat/completions` as server-sent events; the arguments of a call come in pieces."""

    def event(delta: dict[str, Any], reason: str | None = None) -> bytes:
        choice = {"index": 0, "delta": delta, "finish_reason": reason}
        return f"data: {json.dumps({'object': 'chat.completion.chunk', 'choices': [choice]})}\n\n".encode()

    chunks = [event({"role": "assistant", "content": None}), b": a comment\n\n"]
    chunks += [event({"content": f"{piece} "}) for piece in text.split()]
    for index, (name, arguments) in enumerate(calls):
        begin = {"index": index, "id": f"call_{index}", "type": "function"}
        chunks.append(event({"tool_calls": [begin | {"function": {"name": name, "arguments": ""}}]}))
        for piece in (arguments[:5], arguments[5:]):
            chunks.append(event({"tool_calls": [{"index": index, "function": {"arguments": piece}}]}))
    if not cut:
        chunks += [event({}, "tool_calls" if calls else "stop"), b"data: [DONE]\n\n"]
    return response(chunks, "text/event-stream", cut=cut)


def failure(status: str, body: dict[str, Any]) -> bytes:
    return response([json.dumps(body).encode()], "application/json", status=status)


@asynccontextmanager
async def serving(*answers: bytes, wait_s: float = 0.0) -> AsyncIterator[Script]:
    """Serve a script. `wait_s`: silence before each answer."""
    script = Script(answers)
    tasks: set[asyncio.Task[None]] = set()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        first, *lines = head.split("\r\n")
        script.headers = {key.lower(): value for key, _, value in (line.partition(": ") for line in lines)}
        body = await reader.readexactly(int(script.headers["content-length"]))
        script.requests.append((first.split()[1], json.loads(body)))
        await asyncio.sleep(wait_s)
        writer.write(script.next())
        await writer.drain()
        writer.close()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(answer(reader, writer))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    script.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    try:
        yield script
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
