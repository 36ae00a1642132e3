"""Model card of ``vla0_smol``: the text about its method."""

from lerobot_bomb.hub.method import Method, Paper

METHOD = Method(
    summary="a stock vision-language model is fine-tuned to write the next actions as decimal integers, "
    "without any new head: the recipe of VLA-0 and VLA-0-Smol.",
    backbone="HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
    backbone_license="apache-2.0",
    papers=(
        Paper(
            "goyal2025vla0",
            "VLA-0: Building State-of-the-Art VLAs with Zero Modification",
            "Goyal, Ankit and others",
            2025,
            "2510.13054",
        ),
        Paper(
            "marafioti2025smolvlm",
            "SmolVLM: Redefining small and efficient multimodal models",
            "Marafioti, Andres and others",
            2025,
            "2504.05299",
        ),
    ),
)
