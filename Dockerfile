# docker build -t d4orm . && docker run --rm -v "$PWD:/work" d4orm demo --out demo
FROM python:3.13-slim
COPY pyproject.toml README.md LICENSE /source/
COPY d4orm_env /source/d4orm_env
COPY d4orm_planners /source/d4orm_planners
RUN pip install --no-cache-dir /source && rm -r /source
ENV NUMBA_CACHE_DIR=/var/cache/d4orm
RUN d4orm warmup
WORKDIR /work
ENTRYPOINT ["d4orm"]
