# The service in one container: docker build -t osf . && docker run -p 127.0.0.1:8000:8000 -v osf-data:/data osf
FROM debian:bookworm-slim

# Where torch comes from: the CPU-only builds. Set it to nothing for the default index, whose builds carry CUDA.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu

# Debian's python3 is 3.11, for which PyBullet has wheels (x86-64); expat and glib-free: opencv is the headless build.
RUN apt-get update \
 && apt-get install -y --no-install-recommends ca-certificates python3 python3-venv \
 && rm -rf /var/lib/apt/lists/*

ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PIP_NO_CACHE_DIR=1
WORKDIR /opt/osf
COPY requirements.lock ./
RUN python3 -m venv /opt/venv \
 && pip install -c requirements.lock ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} torch
COPY pyproject.toml README.md LICENSE ./
COPY .ci/editable.py .ci/
COPY osfcore osfcore
COPY app app
COPY static static
RUN pip install -c requirements.lock '.[serve,heic,video]'

RUN useradd --create-home --uid 1000 osf && install -d -o osf /data
USER osf
ENV OSF_DATA_DIR=/data
VOLUME /data
EXPOSE 8000
HEALTHCHECK --start-period=120s --interval=30s --timeout=5s \
  CMD python3 -c "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/api/health', timeout=4)"

# Objects are fetched into the volume at the first start; later starts find them there.
CMD ["sh", "-c", "osf assets fetch && exec osf serve --host 0.0.0.0 --port 8000"]
