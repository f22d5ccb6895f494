# Environments, world model and agents on a CPU:  docker build -t vssm-gym . && docker run --rm vssm-gym doctor
FROM python:3.11-slim AS build
WORKDIR /src
RUN python -m pip install --no-cache-dir build
COPY . .
RUN python -m build --wheel --outdir /dist .

FROM python:3.11-slim
COPY --from=build /dist /dist
COPY constraints.txt /dist/
RUN python -m pip install --no-cache-dir -c /dist/constraints.txt /dist/vssm_gym-*.whl && rm -r /dist
RUN useradd --create-home robot
USER robot
WORKDIR /home/robot
ENTRYPOINT ["vssm-gym"]
CMD ["--help"]
