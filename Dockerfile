# The first stage builds a virtual environment; the second runs it as an unprivileged user.
# The digest is that of python:3.12.14-slim-trixie for all machines; Dependabot proposes newer ones.
ARG BASE=python:3.12-slim@sha256:78387bc3881b8273120a12ebe6c1ab22b018ccc2c9adf565ae1ac9b536e184ea
FROM ${BASE} AS build
# constraints-bridges.txt adds what `plc-gateway bridge mqtt` and `bridge opcua` need.
ARG PINS=constraints.txt
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY ${PINS} constraints.txt
COPY gateway gateway
COPY packaging/sbom.cdx.json packaging/sbom.cdx.json
RUN python -m venv /opt/gateway \
    && /opt/gateway/bin/pip install --no-cache-dir --require-hashes --requirement constraints.txt \
    && /opt/gateway/bin/pip install --no-cache-dir --no-deps --no-build-isolation . \
    && /opt/gateway/bin/pip uninstall --yes \
        hatchling packaging pathspec pluggy tomlkit trove-classifiers

FROM ${BASE}
# Serial ports belong to the group dialout: docker run --device /dev/ttyUSB0 --group-add dialout ...
RUN useradd --system --uid 10001 --user-group --groups dialout --home-dir /data --create-home gateway
COPY --from=build /opt/gateway /opt/gateway
COPY config.example.yaml /etc/plc-gateway/config.yaml
# Relative paths of files that the gateway writes are below STATE_DIRECTORY.
ENV PATH=/opt/gateway/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 STATE_DIRECTORY=/data
USER 10001:10001
WORKDIR /data
VOLUME /data
EXPOSE 7447
# The gateway writes only below /data: run it with --read-only.
# With `users_file` the health check needs -e PLC_GATEWAY_CLI_USER -e PLC_GATEWAY_CLI_PASSWORD
# (docs/security.md).
HEALTHCHECK --interval=30s --timeout=10s --start-period=15s \
    CMD ["plc-gateway", "health", "/etc/plc-gateway/config.yaml"]
ENTRYPOINT ["plc-gateway"]
CMD ["run", "/etc/plc-gateway/config.yaml", "--log-format", "json"]
