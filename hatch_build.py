"""The README as a package index shows it, linked to the repository of `make build REPOSITORY=URL`."""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# a relative target of a Markdown link or image: no scheme, no anchor of the page itself
LINK = re.compile(r"(?P<image>!?)(?P<text>\[[^\]]*\])\((?P<target>(?![a-z]+:|#)[^)\s]+)\)")


class CustomMetadataHook(MetadataHookInterface):
    """Hook that fills in the fields that pyproject.toml leaves to the build."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set readme and URLs."""
        readme = (Path(self.root) / "README.md").read_text()
        if repository := os.environ.get("REPOSITORY", "").rstrip("/"):
            readme = absolute_links(readme, repository, f"v{metadata['version']}")
            metadata["urls"] = {
                "Repository": repository,
                "Documentation": f"{repository}/blob/v{metadata['version']}/docs/README.md",
                "Changelog": f"{repository}/blob/v{metadata['version']}/CHANGELOG.md",
                "Issues": f"{repository}/issues",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": readme}


def absolute_links(text: str, repository: str, tag: str) -> str:
    """Return Markdown whose relative links lead to a repository's files at a tag."""

    def absolute(found: re.Match[str]) -> str:
        kind = "raw" if found["image"] else "blob"
        return f"{found['image']}{found['text']}({repository}/{kind}/{tag}/{found['target']})"

    return LINK.sub(absolute, text)
