# docker build -t sysid-btr . && docker run --rm -v "$PWD:/work" sysid-btr fit --model robot.xml --log walk.parquet
FROM python:3.12-slim
COPY . /src
RUN pip install --no-cache-dir "/src[posterior,ros]" && rm -rf /src
WORKDIR /work
ENTRYPOINT ["sysid-btr"]
