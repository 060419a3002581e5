# thermocald in a container: Debian slim, not root, a read-only root file system, a health check.
#   docker build -t thermocald .        or podman, buildah
FROM docker.io/library/debian:trixie-slim AS build
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv ca-certificates \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY packaging/lock/runtime.txt packaging/lock/
RUN python3 -m venv /opt/thermocald \
    && /opt/thermocald/bin/pip install --no-cache-dir --require-hashes -r packaging/lock/runtime.txt
COPY drivers drivers
COPY thermocald thermocald
RUN /opt/thermocald/bin/pip install --no-cache-dir --no-deps .

FROM docker.io/library/debian:trixie-slim
RUN apt-get update && apt-get install -y --no-install-recommends python3 adb \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 990 --create-home --home-dir /var/lib/thermocald thermocald
COPY --from=build /opt/thermocald /opt/thermocald
COPY config.yaml /etc/thermocald/config.yaml
RUN sed -i -e 's|^  path: thermocald.db|  path: /var/lib/thermocald/thermocald.db|' \
    -e 's|^  folder: frames|  folder: /var/lib/thermocald/frames|' /etc/thermocald/config.yaml
ENV PATH=/opt/thermocald/bin:$PATH OPENBLAS_NUM_THREADS=1 PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
USER thermocald
WORKDIR /var/lib/thermocald
VOLUME /var/lib/thermocald
HEALTHCHECK --interval=1m --timeout=20s --start-period=3m \
    CMD ["thermocald", "status", "--config", "/etc/thermocald/config.yaml"]
ENTRYPOINT ["thermocald"]
CMD ["run", "--config", "/etc/thermocald/config.yaml"]
