# The CPU image:   docker build -t swimm3r .
# The CUDA image:  docker build -t swimm3r:cuda --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 --build-arg EXTRAS='[cuda]' .
#
# A run:           docker run --rm -v "$PWD:/data" swimm3r run /data/dive.mp4 --out /data/runs/dive
# With a GPU:      docker run --rm --gpus all -v "$PWD:/data" swimm3r:cuda run /data/dive.mp4 --out /data/runs/dive --preset best
FROM python:3.12-slim AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=""
WORKDIR /source
COPY pyproject.toml README.md LICENSE NOTICE ./
COPY src ./src
RUN python -m venv /opt/swimm3r \
 && /opt/swimm3r/bin/pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" ".${EXTRAS}"

FROM python:3.12-slim
RUN apt-get update \
 && apt-get install -y --no-install-recommends libgl1 libglib2.0-0 libgomp1 \
 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/swimm3r /opt/swimm3r
# kernels are compiled once and kept in the volume that holds the user's data, or in the container
ENV PATH=/opt/swimm3r/bin:$PATH NUMBA_CACHE_DIR=/var/cache/swimm3r
RUN mkdir -p /var/cache/swimm3r && chmod 1777 /var/cache/swimm3r
ENTRYPOINT ["swimm3r"]
CMD ["--help"]
