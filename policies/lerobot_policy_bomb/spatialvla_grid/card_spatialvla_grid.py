"""Model card of ``spatialvla_grid``: the text about its method."""

from lerobot_bomb.hub.method import Method, Paper

METHOD = Method(
    summary="a PaliGemma 2 chooses, for each step of a chunk, one cell of every adaptive action grid: "
    "SpatialVLA, rebuilt on transformers' own classes.",
    backbone="google/paligemma2-3b-pt-224",
    backbone_license="gemma",
    papers=(
        Paper(
            "qu2025spatialvla",
            "SpatialVLA: Exploring Spatial Representations for Visual-Language-Action Model",
            "Qu, Delin and others",
            2025,
            "2501.15830",
        ),
        Paper(
            "steiner2024paligemma2",
            "PaliGemma 2: A Family of Versatile VLMs for Transfer",
            "Steiner, Andreas and others",
            2024,
            "2412.03555",
        ),
    ),
)
