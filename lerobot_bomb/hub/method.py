"""Methods and papers: text of a policy type's model card that is the same for all checkpoints."""

from dataclasses import dataclass

from lerobot_bomb import __version__


@dataclass(frozen=True)
class Paper:
    """Paper that a checkpoint's user should cite."""

    key: str  # of the BibTeX entry
    title: str
    authors: str
    year: int | None = None
    arxiv: str | None = None
    version: str | None = None  # of software

    def bibtex(self) -> str:
        """Return a BibTeX entry."""
        entry = {"title": f"{{{self.title}}}", "author": self.authors}
        if self.year is not None:
            entry["year"] = str(self.year)
        if self.version is not None:
            entry["version"] = self.version
        if self.arxiv is not None:
            entry |= {"eprint": self.arxiv, "archivePrefix": "arXiv"}
        fields = ",\n".join(f"  {name} = {{{value}}}" for name, value in entry.items())
        return f"@misc{{{self.key},\n{fields}\n}}"


# as CITATION.cff has it
BOMB = Paper(
    "lerobot_bomb",
    "BOMB: a precise placement benchmark and vision-language-action policies for LeRobot",
    r"{The lerobot\_bomb authors}",
    version=__version__,
)


@dataclass(frozen=True)
class Method:
    """A policy type in words, its sources, and its default backbone."""

    summary: str
    papers: tuple[Paper, ...]
    backbone: str | None = None  # Hub id; None: it has none
    backbone_license: str = "apache-2.0"  # as a card's metadata names it; without a backbone, of our weights
    backbone_license_name: str | None = None  # where the former is "other"
