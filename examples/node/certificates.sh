#!/usr/bin/env bash
# Makes a certificate authority, if the folder has none yet, and a certificate for each robot, signed by it:
#
#   certificates.sh FOLDER robot0=192.168.1.10 robot1=192.168.1.11
#
# Copy ca.pem and the robot's own robot.key and robot.pem to each robot. Keep ca.key where no robot can read it.
set -euo pipefail
umask 077
if [ $# -lt 2 ]; then
  echo "usage: certificates.sh FOLDER NAME=ADDRESS..., as robot0=192.168.1.10" >&2
  exit 2
fi
folder=$1
shift
mkdir -p "$folder"

[ -e "$folder/ca.key" ] ||
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 365 -subj "/CN=d4orm team" \
    -keyout "$folder/ca.key" -out "$folder/ca.pem"

for robot in "$@"; do
  name=${robot%%=*}
  address=${robot#*=}
  mkdir -p "$folder/$name"
  openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj "/CN=$name" \
    -keyout "$folder/$name/robot.key" -out "$folder/$name/request.pem"
  openssl x509 -req -in "$folder/$name/request.pem" -CA "$folder/ca.pem" -CAkey "$folder/ca.key" -CAcreateserial \
    -days 365 -out "$folder/$name/robot.pem" \
    -extfile <(printf 'subjectAltName=DNS:%s,IP:%s\nextendedKeyUsage=serverAuth,clientAuth\n' "$name" "$address")
  rm "$folder/$name/request.pem"
done
