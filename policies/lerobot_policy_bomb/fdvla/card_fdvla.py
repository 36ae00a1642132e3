"""Model card of ``fdvla``: the text about its method."""

from lerobot_bomb.hub.method import Method, Paper

METHOD = Method(
    summary="a Qwen2.5-VL reads noisy actions beside images, instruction and state; a flow head and a "
    "denoising head take them to clean ones in a few steps. A reconstruction of FDVLA, not a reproduction.",
    backbone="Qwen/Qwen2.5-VL-3B-Instruct",
    backbone_license="other",
    backbone_license_name="qwen-research",
    papers=(
        Paper(
            "fdvla",
            "FDVLA: A Flow-Diffusion Vision-Language-Action Framework with Dual Reasoning Modulation",
            "Anonymous",
        ),
        Paper("bai2025qwen25vl", "Qwen2.5-VL Technical Report", "Bai, Shuai and others", 2025, "2502.13923"),
    ),
)
