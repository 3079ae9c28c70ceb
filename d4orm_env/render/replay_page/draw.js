// What a scene holds, and how it is drawn: to scale, in the plane or in space, on a canvas.

const ARRIVED = 1, COLLIDED = 2, CLOSE = 4, TRAIL = 4.0;

function bytesOf(text) { return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)); }

/** Numbers that were rounded to 16 bits, component by component. */
function numbersOf(part) {
  const raw = new Uint16Array(bytesOf(part.data).buffer), width = part.low.length;
  const out = new Float32Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = part.low[i % width] + part.step[i % width] * raw[i];
  return out;
}

/** One team's motion, with what came before it: the denoising of its plan, if that was watched. */
class Scene {
  constructor(data) {
    Object.assign(this, data);
    this.robots = data.radius.length;
    this.states = numbersOf(data.states);
    this.width = data.states.low.length;
    this.flags = bytesOf(data.flags);
    this.clearances = numbersOf(data.world_clearance);
    this.goals = numbersOf(data.goals);
    this.others = data.bodies ? numbersOf(data.bodies) : [];
    this.moments = this.flags.length / this.robots;
    this.prelude = 0;
    if (data.denoising) {
      this.prelude = data.denoising.labels.length * data.denoising.seconds;
      this.paths = numbersOf(data.denoising.paths);
      this.samples = numbersOf(data.denoising.samples);
    }
    this.duration = this.prelude + (this.moments - 1) * this.dt;
  }

  /** Step and the share of the way to the next one. */
  moment(time) {
    const at = Math.min(Math.max((time - this.prelude) / this.dt, 0), this.moments - 1);
    const step = Math.min(Math.floor(at), Math.max(this.moments - 2, 0));
    return [step, this.moments > 1 ? at - step : 0];
  }

  nearest([step, share]) { return Math.min(step + Math.round(share), this.moments - 1); }
  flag(step, robot) { return this.flags[step * this.robots + robot]; }
  component(step, robot, index) { return this.states[(step * this.robots + robot) * this.width + index]; }

  between([step, share], robot, index, circular = false) {
    const here = this.component(step, robot, index);
    let change = share ? this.component(step + 1, robot, index) - here : 0;
    if (circular) change -= 2 * Math.PI * Math.round(change / (2 * Math.PI));
    return here + share * change;
  }

  place(moment, robot) {
    return [0, 1, 2].map((axis) => axis < this.dimension ? this.between(moment, robot, axis) : 0);
  }

  goal(step, robot) {
    const row = this.goals.length > this.robots * this.dimension ? step * this.robots + robot : robot;
    return [0, 1, 2].map((axis) => axis < this.dimension ? this.goals[row * this.dimension + axis] : 0);
  }

  /** Place and radius of something that moves among the robots and is none. */
  body([step, share], index) {
    const width = this.dimension + 1, count = this.bodies.count;
    const at = (moment, part) => this.others[(moment * count + index) * width + part];
    const jump = share > 0 && Math.hypot(...[0, 1].map((axis) => at(step + 1, axis) - at(step, axis))) > 10 * this.dt;
    const place = [0, 1, 2].map((axis) => axis >= this.dimension ? 0
      : at(step, axis) + (share && !jump ? share * (at(step + 1, axis) - at(step, axis)) : 0));
    return { place, radius: at(step, this.dimension) };
  }

  speed(step, robot) {
    const next = Math.min(step + 1, this.moments - 1), last = Math.max(next - 1, 0);
    let sum = 0;
    for (let axis = 0; axis < this.dimension; axis++) {
      sum += (this.component(next, robot, axis) - this.component(last, robot, axis)) ** 2;
    }
    return Math.sqrt(sum) / this.dt;
  }

  /** Distance from a robot's surface to the nearest other robot, obstacle or bound; not known unless all are round. */
  clearance(step, robot) {
    if (this.outlines) return Infinity;
    let least = this.clearances[step * this.robots + robot] - this.radius[robot];
    for (let other = 0; other < this.robots; other++) {
      if (other === robot) continue;
      let sum = 0;
      for (let axis = 0; axis < this.dimension; axis++) {
        sum += (this.component(step, robot, axis) - this.component(step, other, axis)) ** 2;
      }
      least = Math.min(least, Math.sqrt(sum) - this.radius[robot] - this.radius[other]);
    }
    return least;
  }
}

/** Draws a scene on its canvas. */
class Painter {
  constructor(scene, canvas) {
    this.scene = scene;
    this.canvas = canvas;
    this.view = new View(scene.limits, scene.dimension);
    this.still = document.createElement("canvas");
    this.drawn = "";
  }

  /** Everything at a time; `chosen` is a robot to mark, or -1. */
  draw(time, chosen, theme) {
    const box = this.canvas.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(box.width), 1), height = Math.max(Math.round(box.height), 1);
    const denoising = time < this.scene.prelude;
    const state = [width, height, ratio, theme.name, this.view.version, denoising].join();
    if (state !== this.drawn) {
      for (const canvas of [this.canvas, this.still]) {
        canvas.width = width * ratio;
        canvas.height = height * ratio;
      }
      this.view.fit(width, height);
      this.theme = theme;
      this.colors = this.scene.colors.map((color) => readable(color, theme.dark));
      this.paintStill(ratio, !denoising);
      this.drawn = state;
    }
    const pen = this.pen = this.canvas.getContext("2d");
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, this.canvas.width, this.canvas.height);
    pen.drawImage(this.still, 0, 0);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (denoising) this.paintDenoising(time);
    this.paintTeam(this.scene.moment(time), denoising, chosen);
  }

  trace(points) {
    this.pen.beginPath();
    points.forEach((p, i) => this.pen[i ? "lineTo" : "moveTo"](this.view.x(p), this.view.y(p)));
  }

  fill(points, style, edge) {
    this.trace(points);
    this.pen.closePath();
    if (style) { this.pen.fillStyle = style; this.pen.fill(); }
    if (edge) { this.pen.strokeStyle = edge; this.pen.stroke(); }
  }

  disc(place, radius, style, edge) {
    this.pen.beginPath();
    this.pen.arc(this.view.x(place), this.view.y(place), Math.max(radius * this.view.scale, 1), 0, 2 * Math.PI);
    if (style) { this.pen.fillStyle = style; this.pen.fill(); }
    if (edge) { this.pen.strokeStyle = edge; this.pen.stroke(); }
  }

  /** A robot: a disc, or its outline turned by its heading, and its trailers behind it. */
  body(moment, robot, place, style, edge) {
    const { scene } = this;
    if (!scene.outlines) return this.disc(place, scene.radius[robot], style, edge);
    const index = scene.heading[robot];
    let angle = index === null ? 0 : scene.between(moment, robot, index, true);
    this.shape(scene.outlines[robot], place, angle, style, edge);
    for (const { outline, hitch, length } of scene.trailers[robot]) {
      angle -= scene.between(moment, robot, hitch, true);
      place = [place[0] - length * Math.cos(angle), place[1] - length * Math.sin(angle), place[2]];
      this.shape(outline, place, angle, style, edge);
    }
  }

  shape(outline, place, angle, style, edge) {
    const c = Math.cos(angle), s = Math.sin(angle);
    this.trace(outline.map(([x, y]) => [place[0] + c * x - s * y, place[1] + s * x + c * y, place[2]]));
    this.pen.closePath();
    this.pen.fillStyle = style; this.pen.fill();
    this.pen.strokeStyle = edge; this.pen.stroke();
  }

  /** What does not move: bounds, obstacles, and the whole ways, faintly, if they are to be seen. */
  paintStill(ratio, ways) {
    const { scene, theme } = this, pen = this.pen = this.still.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.still.width, this.still.height);
    pen.lineWidth = 1;
    const low = scene.limits[0][2], { world } = scene;
    if (scene.bounds) {
      const [[x0, y0], [x1, y1]] = scene.bounds;
      this.fill([[x0, y0, low], [x1, y0, low], [x1, y1, low], [x0, y1, low]], null, theme.edge);
    }
    if (this.view.spatial) {
      const [[x0, y0], [x1, y1]] = scene.limits;
      this.fill([[x0, y0, low], [x1, y0, low], [x1, y1, low], [x0, y1, low]], theme.page, theme.line);
    }
    pen.globalAlpha = scene.dimension === 3 ? 0.4 : 1;
    for (const part of solids(world, scene.limits, scene.dimension)) {
      if (part.radius) this.disc(part.centre, part.radius, theme.obstacle, theme.edge);
      else this.fill(part.corners, theme.obstacle, theme.edge);
    }
    pen.globalAlpha = 0.4;
    pen.lineWidth = scene.robots > 32 ? 1.2 : 2;
    for (let robot = 0; ways && robot < scene.robots; robot++) {
      pen.strokeStyle = this.colors[robot];
      this.trace(this.way(robot, 0, scene.moments - 1));
      pen.stroke();
    }
    pen.globalAlpha = 1;
    this.paintScale();
  }

  /** A bar of a round number of metres, about a sixth as long as the canvas is wide. */
  paintScale() {
    const { pen, theme, view } = this, most = this.canvas.getBoundingClientRect().width / 6 / view.scale;
    const unit = 10 ** Math.floor(Math.log10(most)), length = unit * [5, 2, 1].find((factor) => factor * unit <= most);
    const [x, y] = [10, this.canvas.getBoundingClientRect().height - 10], end = x + length * view.scale;
    pen.lineWidth = 1.5;
    pen.strokeStyle = pen.fillStyle = theme.ink;
    pen.beginPath();
    pen.moveTo(x, y - 4); pen.lineTo(x, y); pen.lineTo(end, y); pen.lineTo(end, y - 4);
    pen.stroke();
    pen.font = "11px sans-serif";
    pen.fillText(`${Number(length.toPrecision(1))} m`, x + 4, y - 4);
  }

  /** A robot's number in its body, where that is large enough. */
  number(robot, place) {
    const { pen, scene, view } = this, size = Math.min(0.95 * scene.radius[robot] * view.scale, 16);
    if (size < 6) return;
    pen.font = `${size}px sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillStyle = lightness(this.colors[robot]) > 0.6 ? "#1F2937" : "#FFFFFF";
    pen.fillText(String(robot), view.x(place), view.y(place));
    pen.textAlign = "start";
    pen.textBaseline = "alphabetic";
  }

  way(robot, first, last) {
    const points = [];
    for (let step = first; step <= last; step++) points.push(this.scene.place([step, 0], robot));
    return points;
  }

  /** The candidate of one denoising step, and a few of the samples that it was made of. */
  paintDenoising(time) {
    const { scene, pen } = this, { denoising } = scene, d = scene.dimension;
    const step = Math.min(Math.floor(time / denoising.seconds), denoising.labels.length - 1);
    const length = denoising.points, size = length * scene.robots * d;
    const path = (numbers, start, robot) => Array.from({ length }, (_, point) => {
      const at = start + (point * scene.robots + robot) * d;
      return [numbers[at], numbers[at + 1], d === 3 ? numbers[at + 2] : 0];
    });
    const stroke = (numbers, start, robot, alpha, width) => {
      pen.globalAlpha = alpha;
      pen.lineWidth = width;
      pen.strokeStyle = this.colors[robot];
      this.trace(path(numbers, start, robot));
      pen.stroke();
    };
    for (let robot = 0; robot < scene.robots; robot++) {
      for (let sample = 0; sample < denoising.kept; sample++) {
        stroke(scene.samples, (step * denoising.kept + sample) * size, robot, denoising.alpha[step][sample], 0.8);
      }
      stroke(scene.paths, step * size, robot, 0.95, 1.8);
    }
    pen.globalAlpha = 1;
  }

  paintTeam(moment, denoising, chosen) {
    const { scene, view, theme, pen } = this, now = scene.nearest(moment);
    const order = Array.from({ length: scene.robots }, (_, robot) => ({ robot, place: scene.place(moment, robot) }));
    if (view.spatial) order.sort((a, b) => view.depth(a.place) - view.depth(b.place));
    for (const { robot, place } of order) {
      pen.lineWidth = 1.2;
      if (view.spatial) {  // how high it is
        pen.strokeStyle = theme.line;
        this.trace([place, [place[0], place[1], scene.limits[0][2]]]);
        pen.stroke();
      }
      const goal = scene.goal(now, robot), reach = 1.5 * scene.radius[robot] * view.scale;
      const x = view.x(goal), y = view.y(goal);
      pen.strokeStyle = this.colors[robot];
      pen.beginPath();
      pen.moveTo(x + reach, y); pen.lineTo(x, y - reach); pen.lineTo(x - reach, y); pen.lineTo(x, y + reach);
      pen.closePath();
      pen.stroke();
      if (!denoising) this.paintTrail(moment, robot, place);
    }
    for (let index = 0; scene.bodies && !denoising && index < scene.bodies.count; index++) {
      const { place, radius } = scene.body(moment, index);
      pen.lineWidth = 1;
      if (radius > 0.001) this.disc(place, radius, theme.obstacle, theme.ink);
    }
    for (const { robot, place } of order) {
      const flag = denoising ? 0 : scene.flag(now, robot), red = flag & COLLIDED;
      pen.lineWidth = robot === chosen ? 3 : 1;
      pen.globalAlpha = flag & ARRIVED && !red ? 0.55 : 1;
      this.body(moment, robot, place, red ? theme.contact : this.colors[robot],
        flag & CLOSE ? theme.contact : theme.ink);
      pen.globalAlpha = 1;
      const index = scene.heading[robot];
      if (index !== null) {
        const angle = scene.between(moment, robot, index, true), r = scene.radius[robot];
        pen.lineWidth = 2;
        pen.strokeStyle = theme.page;
        const ahead = (share) => [place[0] + share * r * Math.cos(angle), place[1] + share * r * Math.sin(angle), place[2]];
        this.trace([ahead(0.55), ahead(1)]);
        pen.stroke();
      }
      this.number(robot, place);
    }
  }

  paintTrail(moment, robot, place) {
    const { scene, pen } = this, first = Math.max(0, moment[0] - Math.round(TRAIL / scene.dt));
    const points = [...this.way(robot, first, moment[0]), place], part = Math.ceil(points.length / 4);
    pen.lineWidth = scene.robots > 32 ? 1 : 1.8;
    for (let quarter = 0; quarter < 4; quarter++) {
      const piece = points.slice(quarter * part, (quarter + 1) * part + 1);
      if (piece.length < 2) continue;
      pen.globalAlpha = 0.25 * (quarter + 1);
      this.trace(piece);
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  /** The robot at a place on the canvas, or -1. */
  robotAt(x, y, time) {
    const moment = this.scene.moment(time);
    let best = -1, least = Infinity;
    for (let robot = 0; robot < this.scene.robots; robot++) {
      const place = this.scene.place(moment, robot);
      const distance = Math.hypot(this.view.x(place) - x, this.view.y(place) - y);
      if (distance < Math.max(this.scene.radius[robot] * this.view.scale, 12) && distance < least) {
        least = distance;
        best = robot;
      }
    }
    return best;
  }
}
