# Environments, world model and agents on a CPU:  docker build -t vssm-gym . && docker run --rm vssm-gym doctor
# A container's files are lost with it, so a command with --out writes to a folder of the host, as the user who owns it:
#   mkdir -p out
#   docker run --rm -v "$PWD/out:/out" --user "$(id -u):$(id -g)" -e HOME=/tmp vssm-gym demo --out /out/demo
FROM python:3.11-slim AS build
WORKDIR /src
COPY constraints.txt .
RUN python -m pip install --no-cache-dir -c constraints.txt build
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
