"""Hash scenes, task sets and splits, to tell whether they are those that results were made with."""

import hashlib
import json

from pydantic import BaseModel


def content_hash(model: BaseModel, without: str) -> str:
    """Return the first 16 hex digits of the SHA-256 of the model's canonical JSON without one field.

    Canonical JSON has sorted keys and no spaces.
    """
    content = model.model_dump(mode="json", exclude={without})
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]
