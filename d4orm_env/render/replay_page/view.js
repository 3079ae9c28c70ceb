"use strict";
// Where things are on a canvas, and what shape and colour they have.

/** An orthographic view of the box between two corners: from above in the plane, turned by two angles in space. */
class View {
  constructor(limits, dimension) {
    this.limits = limits;
    this.spatial = dimension === 3;
    const [x, y, z] = limits[1].map((high, axis) => high - limits[0][axis]);
    this.azimuth = -Math.PI / 3;
    this.elevation = z > 0.5 * Math.max(x, y) ? 0.44 : 0.79;
    this.version = 0;
  }

  turn(right, up) {
    this.azimuth -= right;
    this.elevation = Math.min(1.57, Math.max(0.05, this.elevation + up));
    this.version++;
  }

  fit(width, height) {
    const a = this.azimuth, e = this.elevation;
    this.right = this.spatial ? [-Math.sin(a), Math.cos(a), 0] : [1, 0, 0];
    this.up = this.spatial ? [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)] : [0, 1, 0];
    this.near = this.spatial ? [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)] : [0, 0, 1];
    this.centre = this.limits[0].map((low, axis) => (low + this.limits[1][axis]) / 2);
    let wide = 1e-6, high = 1e-6;
    for (let corner = 0; corner < 8; corner++) {
      const offset = this.centre.map((middle, axis) => this.limits[(corner >> axis) & 1][axis] - middle);
      wide = Math.max(wide, Math.abs(dot(this.right, offset)));
      high = Math.max(high, Math.abs(dot(this.up, offset)));
    }
    this.scale = 0.5 * Math.min((width - 12) / wide, (height - 12) / high);
    this.middle = [width / 2, height / 2];
  }

  x(p) { return this.middle[0] + this.scale * dotFrom(this.right, p, this.centre); }
  y(p) { return this.middle[1] - this.scale * dotFrom(this.up, p, this.centre); }
  depth(p) { return dotFrom(this.near, p, this.centre); }
}

function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function dotFrom(a, p, c) { return a[0] * (p[0] - c[0]) + a[1] * (p[1] - c[1]) + a[2] * (p[2] - c[2]); }

/** The obstacles as discs that face the reader and as polygons. */
function solids(world, limits, dimension) {
  const parts = [], ring = (x, y, z, r) => Array.from({ length: 36 }, (_, i) =>
    [x + r * Math.cos(i * Math.PI / 18), y + r * Math.sin(i * Math.PI / 18), z]);
  for (const ball of world.balls) {
    parts.push({ centre: [ball[0], ball[1], dimension === 3 ? ball[2] : 0], radius: ball[dimension] });
  }
  for (const [x, y, r] of world.cylinders) {
    const [low, high] = limits.map((corner) => ring(x, y, corner[2], r));
    for (let i = 0; i < 36; i += 3) parts.push({ corners: [low[i], low[(i + 3) % 36], high[(i + 3) % 36], high[i]] });
    parts.push({ corners: low }, { corners: high });
  }
  for (const box of world.boxes) {
    const corner = (i, j, k) => [box[i ? dimension : 0], box[j ? dimension + 1 : 1], dimension === 3 ? box[k ? 5 : 2] : 0];
    const face = (...all) => parts.push({ corners: all.map((bits) => corner(bits & 1, bits & 2, bits & 4)) });
    face(0, 1, 3, 2);
    if (dimension === 3) { face(4, 5, 7, 6); face(0, 1, 5, 4); face(2, 3, 7, 6); face(0, 2, 6, 4); face(1, 3, 7, 5); }
  }
  for (const polygon of world.polygons) parts.push({ corners: polygon.map(([x, y]) => [x, y, 0]) });
  return parts;
}

/** A robot's colour, lighter on a dark page where it is dark itself. */
function readable(color, dark) {
  const rgb = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  const light = (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]) / 255;
  const share = dark && light < 0.45 ? 0.6 - light : 0;
  return `rgb(${rgb.map((part) => Math.round(part + share * (255 - part))).join()})`;
}

/** How light a colour is, `rgb(r,g,b)`, from 0 to 1. */
function lightness(color) {
  const [r, g, b] = color.match(/\d+/g).map(Number);
  return (0.299 * r + 0.587 * g + 0.114 * b) / 255;
}
