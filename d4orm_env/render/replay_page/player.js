// One clock for all scenes, and what plays, pauses and scrubs it.

const data = JSON.parse(document.getElementById("data").textContent);
const part = (id) => document.getElementById(id);
const SPEEDS = Array.from(part("speed").options, (option) => option.value);

const player = { time: 0, playing: false, speed: 1, chosen: -1, hovered: [-1, -1], last: 0, frames: 0, dirty: true };
const shows = data.scenes.map((scene, index) => makeShow(new Scene(scene), index));
player.duration = Math.max(...shows.map((show) => show.scene.duration), 1e-3);
player.dt = Math.min(...shows.map((show) => show.scene.dt));

/** A scene's figure on the page. */
function makeShow(scene, index) {
  const figure = document.createElement("figure"), texts = {};
  for (const [tag, name, text] of [["figcaption", "title", scene.title], ["p", "figures", scene.figures]]) {
    texts[name] = document.createElement(tag);
    texts[name].className = name;
    texts[name].textContent = text;
    if (text !== document.title) figure.append(texts[name]);
  }
  const frame = document.createElement("div"), canvas = document.createElement("canvas");
  frame.className = "view";
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${scene.title}: ${scene.figures}`);
  frame.append(canvas);
  figure.append(frame);
  for (const name of ["now", "robot"]) {
    texts[name] = document.createElement("p");
    texts[name].className = name;
    figure.append(texts[name]);
  }
  part("scenes").append(figure);
  const painter = new Painter(scene, canvas);
  listenToCanvas(canvas, painter, index);
  return { scene, painter, texts };
}

function listenToCanvas(canvas, painter, index) {
  let grip = null;
  canvas.addEventListener("pointerdown", (event) => {
    grip = [event.clientX, event.clientY];
    if (painter.view.spatial) canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (grip && painter.view.spatial) {
      painter.view.turn((event.clientX - grip[0]) / 150, (event.clientY - grip[1]) / 150);
      grip = [event.clientX, event.clientY];
    }
    const box = canvas.getBoundingClientRect();
    player.hovered = [index, painter.robotAt(event.clientX - box.left, event.clientY - box.top, player.time)];
    player.dirty = true;
  });
  for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
    canvas.addEventListener(end, () => {
      grip = null;
      if (end === "pointerleave") player.hovered = [-1, -1];
      player.dirty = true;
    });
  }
}

function describeTeam(scene, time) {
  if (time < scene.prelude) {
    return scene.denoising.labels[Math.min(Math.floor(time / scene.denoising.seconds), scene.denoising.labels.length - 1)];
  }
  const now = scene.nearest(scene.moment(time));
  let arrived = 0, contacts = 0, least = Infinity;
  for (let robot = 0; robot < scene.robots; robot++) {
    arrived += scene.flag(now, robot) & ARRIVED ? 1 : 0;
    contacts += scene.flag(now, robot) & COLLIDED ? 1 : 0;
    least = Math.min(least, scene.clearance(now, robot));
  }
  const gap = least < 1e6 ? `, closest approach ${(100 * least).toFixed(1)} cm` : "";
  return `arrived ${arrived} of ${scene.robots}${gap}${contacts ? `, ${contacts} in contact` : ""}`;
}

function describeRobot(scene, time, robot) {
  if (robot < 0 || robot >= scene.robots) return "";
  const now = scene.nearest(scene.moment(time)), clearance = scene.clearance(now, robot);
  const state = scene.names[robot].map((name, index) => `${name} ${scene.component(now, robot, index).toFixed(2)}`);
  const gap = clearance < 1e6 ? `clearance ${(100 * clearance).toFixed(1)} cm, ` : "";
  const speed = `speed ${scene.speed(now, robot).toFixed(2)} m/s, `;
  return `robot_${robot} (${scene.models[robot]}): ${speed}${gap}${state.join(", ")}`;
}

function themeOf(name) {
  const style = getComputedStyle(document.documentElement), color = (key) => style.getPropertyValue(`--${key}`).trim();
  const keys = ["page", "ink", "line", "obstacle", "edge", "contact"];
  return { name, dark: name === "dark", ...Object.fromEntries(keys.map((key) => [key, color(key)])) };
}

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  part("theme").textContent = name === "dark" ? "Light" : "Dark";
  player.theme = themeOf(name);
  player.dirty = true;
}

function play(wanted) {
  if (wanted && player.time >= player.duration) player.time = 0;
  player.playing = wanted;
  part("play").textContent = wanted ? "Pause" : "Play";
  player.dirty = true;
}

function seek(time) {
  player.time = Math.min(Math.max(time, 0), player.duration);
  player.dirty = true;
}

function setSpeed(value) {
  part("speed").value = value;
  player.speed = Number(value);
}

function choose(robot) {
  const most = Math.max(...shows.map((show) => show.scene.robots));
  player.chosen = ((robot + 1 + most + 1) % (most + 1)) - 1;
  part("robot").value = String(player.chosen);
  player.dirty = true;
}

/** Contacts, in red, along the time. */
function paintMarks() {
  const canvas = document.querySelector("#marks canvas"), pen = canvas.getContext("2d");
  canvas.width = canvas.clientWidth;
  canvas.height = canvas.clientHeight;
  pen.fillStyle = player.theme.contact;
  for (const { scene } of shows) {
    for (let step = 0; step < scene.moments; step++) {
      let contact = false;
      for (let robot = 0; robot < scene.robots; robot++) contact ||= (scene.flag(step, robot) & COLLIDED) > 0;
      if (contact) pen.fillRect((scene.prelude + step * scene.dt) / player.duration * canvas.width, 0, 2, canvas.height);
    }
  }
}

function frame(now) {
  if (player.playing) {
    seek(player.time + player.speed * Math.min(now - player.last, 250) / 1000);
    if (player.time >= player.duration) play(false);
  }
  player.last = now;
  if (player.dirty) {
    player.dirty = false;
    player.frames++;
    shows.forEach(({ scene, painter, texts }, index) => {
      const robot = player.hovered[0] === index && player.hovered[1] >= 0 ? player.hovered[1] : player.chosen;
      painter.draw(player.time, robot, player.theme);
      texts.now.textContent = describeTeam(scene, player.time);
      texts.robot.textContent = describeRobot(scene, player.time, robot);
    });
    part("scrub").value = String(1000 * player.time / player.duration);
    part("clock").textContent = `${player.time.toFixed(1)} of ${player.duration.toFixed(1)} s`;
  }
  requestAnimationFrame(frame);
}

const KEYS = {
  " ": () => play(!player.playing), k: () => play(!player.playing),
  ArrowLeft: () => seek(player.time - player.dt), ArrowRight: () => seek(player.time + player.dt),
  Home: () => seek(0), End: () => seek(player.duration),
  "+": () => setSpeed(SPEEDS[Math.min(SPEEDS.indexOf(part("speed").value) + 1, SPEEDS.length - 1)]),
  "-": () => setSpeed(SPEEDS[Math.max(SPEEDS.indexOf(part("speed").value) - 1, 0)]),
  "[": () => choose(player.chosen - 1), "]": () => choose(player.chosen + 1),
};
const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const tag = event.target.tagName;
  if (tag === "SELECT" || (event.key === " " && (tag === "BUTTON" || tag === "SUMMARY"))) return;
  if (event.shiftKey && TURNS[event.key]) {
    shows.forEach(({ painter }) => painter.view.turn(...TURNS[event.key]));
    player.dirty = true;
  } else if (KEYS[event.key]) {
    KEYS[event.key]();
  } else {
    return;
  }
  event.preventDefault();
});
part("play").addEventListener("click", () => play(!player.playing));
part("scrub").addEventListener("input", (event) => seek(event.target.value / 1000 * player.duration));
part("speed").addEventListener("change", (event) => setSpeed(event.target.value));
part("robot").addEventListener("change", (event) => choose(Number(event.target.value)));
part("theme").addEventListener("click", () => setTheme(player.theme.dark ? "light" : "dark"));
window.addEventListener("resize", () => { player.dirty = true; paintMarks(); });
for (let robot = 0; robot < Math.max(...shows.map((show) => show.scene.robots)); robot++) {
  part("robot").add(new Option(`robot_${robot}`, String(robot)));
}
setTheme(window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
paintMarks();
player.last = performance.now();
play(data.autoplay);
frame(player.last);
