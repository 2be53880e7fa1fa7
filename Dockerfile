# The image of every service: head, collector, driver, learner.
#
#   docker build --tag adaafford .
#
# Nothing in it runs as root. Ray comes in its full installation, which alone has the dashboard's agent: without that there
# are neither metrics for Prometheus nor `ray job submit`.

FROM python:3.11-slim-bookworm AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY adaafford adaafford
COPY shared shared
COPY collector collector
COPY learner learner
COPY cluster cluster
# Of the package, separated by commas.
ARG EXTRAS=cluster
RUN python -m venv /opt/adaafford \
    && /opt/adaafford/bin/pip install --no-cache-dir --constraint constraints.txt ".[${EXTRAS}]"

FROM python:3.11-slim-bookworm
# KubeRay checks a pod's health by a command that calls wget.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends wget \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 1000 --create-home adaafford \
    && install --directory --owner=1000 --group=1000 /data
COPY --from=build /opt/adaafford /opt/adaafford
ENV PATH=/opt/adaafford/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    RAY_AUTH_MODE=token \
    RAY_USAGE_STATS_ENABLED=0 \
    OMP_NUM_THREADS=1 \
    ADAAFFORD_LOG=json
USER 1000:1000
WORKDIR /data
CMD ["adaafford", "--help"]
