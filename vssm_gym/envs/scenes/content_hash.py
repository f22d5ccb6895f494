"""The hash that says whether a scene, a task set or a split is the one that results were made with."""

import hashlib
import json

from pydantic import BaseModel


def content_hash(model: BaseModel, without: str) -> str:
    """First 16 hex digits of the SHA-256 of the model's canonical JSON (sorted keys, no spaces) but for one field."""
    content = model.model_dump(mode="json", exclude={without})
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]
