"""The settings of plain sentences."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.settings.section import Section
from companion.settings.texts import HTTP_URL


class LanguageSection(Section):
    """The language model of `companion ask`, and of the chat in page and console."""

    url: Annotated[str, HTTP_URL] = "http://127.0.0.1:11434"
    """address of Ollama, or of an OpenAI-compatible endpoint, which ends with /v1 (extra `language`)"""
    model: str = ""
    """name of the model; empty: plain sentences are read by patterns, without a model"""
    key_file: str | None = None
    """file with the endpoint's API key, readable by its owner only"""
    may: tuple[str, ...] = ()
    """flight commands that need no confirmation by the operator"""
    timeout_s: Annotated[float, Field(ge=1, le=3600)] = 120.0
    """maximum duration of one answer of the model, seconds"""
