# docker build -t legged_torque . && docker run --rm -p 8080:8080 legged_torque    serves the demo's page, without a GPU.
# With one: docker build --build-arg TORCH_INDEX=https://pypi.org/simple ..., docker run --gpus all ... legged-torque train
FROM python:3.12-slim-bookworm
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev libegl1 libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /legged_torque
COPY . .
RUN pip install --no-cache-dir torch --index-url "$TORCH_INDEX" \
    && pip install --no-cache-dir -e ".[viewer,video,export,plots]"
EXPOSE 8080
CMD ["legged-torque", "demo", "--host", "0.0.0.0"]
