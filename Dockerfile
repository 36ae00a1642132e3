# For machines with an NVIDIA GPU and its container toolkit: docker build -t lerobot-bomb .
#   docker run --gpus=all --shm-size=8g -v "$PWD/outputs:/outputs" lerobot-bomb lerobot-bomb doctor
# torch's wheels bring CUDA's libraries; Ubuntu 24.04 brings Python 3.12
FROM nvidia/cuda:13.0.2-base-ubuntu24.04
# FFmpeg reads a dataset's videos; libegl1 renders, on the GPU with its driver's graphics
RUN apt-get update \
    && apt-get install -y --no-install-recommends ffmpeg libegl1 libgl1 python3-venv \
    && rm -rf /var/lib/apt/lists/*
ENV NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility MUJOCO_GL=egl HF_HOME=/outputs/huggingface
ENV PATH=/opt/venv/bin:$PATH
COPY . /src
RUN python3 -m venv /opt/venv && pip install --no-cache-dir -c /src/constraints.txt '/src[lora]'
WORKDIR /outputs
