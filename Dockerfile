# The images: targets robot, vision, sim, keys, examples. compose.yaml runs them together.
# Plain multi-stage: works with BuildKit and without.

# --- base of all images: a user without rights, and the folders that it may write to when they are mounted ------------
FROM python:3.11-slim-bookworm AS service
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin sightline \
 && install -d -m 0700 -o sightline -g sightline /run/sightline /var/lib/sightline \
                      /keys /keys/site /keys/router /keys/robot /keys/vision /keys/operator
ENV PATH=/opt/sightline/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    SIGHTLINE_ROBOT__STATE_DIR=/var/lib/sightline
USER sightline
WORKDIR /tmp
ENTRYPOINT ["sightline"]

# --- the project as a wheel -------------------------------------------------------------------------------------------
FROM python:3.11-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_CONSTRAINT=/src/constraints.txt
WORKDIR /src
COPY requirements.lock pyproject.toml setup.py README.md LICENSE ./
# The lock's versions as constraints: an extra of a local package cannot be installed by hash.
RUN sed -n 's/^\([[:alnum:]].*[^ \\]\) *\\*$/\1/p' requirements.lock > constraints.txt
# A wheel of the same name and extras without code: what depends on it is built again only when the lock changes.
RUN mkdir sightline protocol robot_side vision_side sim conformance operator_side evaluation training benchmarks \
 && pip wheel --no-deps --wheel-dir /empty .

FROM build AS wheel
COPY sightline sightline
COPY protocol protocol
COPY robot_side robot_side
COPY vision_side vision_side
COPY sim sim
COPY conformance conformance
COPY operator_side operator_side
COPY evaluation evaluation
COPY training training
COPY benchmarks benchmarks
RUN pip wheel --no-deps --wheel-dir /dist .

# --- robot: no OpenCV, no NumPy, no PyBullet --------------------------------------------------------------------------
FROM build AS robot-packages
RUN python -m venv /opt/sightline && /opt/sightline/bin/pip install "$(echo /empty/*.whl)[zenoh,websocket]"
COPY --from=wheel /dist /dist
RUN /opt/sightline/bin/pip install --no-deps --force-reinstall /dist/*.whl

FROM service AS robot
COPY --from=robot-packages /opt/sightline /opt/sightline
CMD ["robot"]

# --- base of vision and sim: OpenCV, NumPy ----------------------------------------------------------------------------
FROM build AS pictures
RUN python -m venv /opt/sightline && /opt/sightline/bin/pip install "$(echo /empty/*.whl)[camera]"

# --- vision -----------------------------------------------------------------------------------------------------------
FROM pictures AS vision-packages
RUN /opt/sightline/bin/pip install "$(echo /empty/*.whl)[vision,websocket,metrics]"
COPY --from=wheel /dist /dist
RUN /opt/sightline/bin/pip install --no-deps --force-reinstall /dist/*.whl

FROM service AS vision
COPY --from=vision-packages /opt/sightline /opt/sightline
CMD ["vision"]

# --- sim --------------------------------------------------------------------------------------------------------------
FROM pictures AS sim-packages
# PyBullet has a ready-made wheel for x86_64 only; elsewhere pip compiles it, with the NumPy of `pictures` present: without
# NumPy each image of the simulated camera would be a tuple. No debug symbols, as in environment.py.
RUN [ "$(uname -m)" = x86_64 ] || { apt-get update && apt-get install -y --no-install-recommends g++ \
 && /opt/sightline/bin/pip install setuptools \
 && CFLAGS="-O2 -g0 -w" CXXFLAGS="-O2 -g0 -w" /opt/sightline/bin/pip install --no-build-isolation --use-pep517 pybullet; }
RUN /opt/sightline/bin/pip install "$(echo /empty/*.whl)[sim]"
COPY --from=wheel /dist /dist
RUN /opt/sightline/bin/pip install --no-deps --force-reinstall /dist/*.whl

FROM service AS sim
COPY --from=sim-packages /opt/sightline /opt/sightline
CMD ["sim"]

# --- keys: makes certificates; no network -----------------------------------------------------------------------------
FROM build AS keys-packages
RUN python -m venv /opt/sightline && /opt/sightline/bin/pip install "$(echo /empty/*.whl)[secure]"
COPY --from=wheel /dist /dist
RUN /opt/sightline/bin/pip install --no-deps --force-reinstall /dist/*.whl

FROM service AS keys
COPY --from=keys-packages /opt/sightline /opt/sightline
CMD ["keys", "--help"]

# --- examples: the programs in examples/, on the image of vision ------------------------------------------------------
FROM vision AS examples
WORKDIR /opt/examples
COPY examples/detector_service.py examples/compose/older_client.py ./
ENTRYPOINT ["python"]
CMD ["detector_service.py", "tcp/127.0.0.1:7447"]
