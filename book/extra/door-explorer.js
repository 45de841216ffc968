// Which doors a run opens, by their lever arms, and a film of one door. Used on the page on doors;
// data by experiments/interactive/doors.py.
"use strict";
(() => {
  const {element, shape, number} = interactive;
  const {home, data} = interactive.figure("door-explorer");
  const WIDTH = 440, LEFT = 76, RIGHT = WIDTH - 14, TOP = 12, BOTTOM = 250;
  const OPENED = TOP + 16, CLOSED = BOTTOM - 16;
  const x = interactive.scale([data.bins[0], data.bins.at(-1)], [LEFT, RIGHT]);
  const y = interactive.scale([0, 100], [CLOSED, OPENED]);
  const share = (ends) => 100 * ends.filter((end) => end === "1").length / ends.length;

  // The doors with a lever arm in an interval: how they end.
  const between = (ends, least, most) =>
    ends.filter((_, door) => least < data.levers[door] && data.levers[door] <= most);

  function draw(ends, needed) {
    svg.replaceChildren();
    interactive.below(svg, x, data.bins, [TOP, BOTTOM], "lever arm [m]", (LEFT + RIGHT) / 2, 1);
    interactive.beside(svg, y, [0, 50, 100], [LEFT, RIGHT], "doors opened [%]", (TOP + BOTTOM) / 2);
    shape(svg, "path", {d: `M${x(needed)} ${TOP}V${BOTTOM}`, class: "needed"});
    ends.forEach((end, door) => {
      const isFilmed = door === data.filmed, apart = 5 * (door % 3 - 1);
      shape(svg, "circle", {
        cx: x(data.levers[door]).toFixed(1), cy: (end === "1" ? OPENED : CLOSED) + apart,
        r: isFilmed ? 7 : 3.5, class: isFilmed ? "point-filmed" : "point-door"});
    });
    const bins = data.bins.slice(1).map((most, i) => [data.bins[i], most])
      .map(([least, most]) => [(least + most) / 2, between(ends, least, most)])
      .filter(([, found]) => found.length);
    shape(svg, "polyline", {class: "share",
      points: bins.map(([middle, found]) => `${x(middle)},${y(share(found))}`).join(" ")});
  }

  const pictures = element(home, "div", {class: "pictures"});
  const svg = interactive.picture(pictures, WIDTH, BOTTOM + 46);
  const film = element(pictures, "video", {controls: "", loop: "", playsinline: ""});
  film.muted = true;
  interactive.legend(home, [
    ["share", "opened, in an interval of lever arms"], ["point-door", "a door"],
    ["point-filmed", "the door of the film"], ["needed", "what one motor needs"],
  ]);
  const controls = element(home, "div", {class: "controls"});
  const values = (key) => [...new Set(data.cases.map((shown) => shown[key]))].map((v) => [v, v]);
  const selects = {
    arm: interactive.select(controls, "arm", Object.entries(data.arms), data.cases[0].arm),
    run: interactive.select(controls, "run", values("run"), data.cases[0].run),
    friction: interactive.select(controls, "friction [N m]", values("friction"),
      data.cases.at(-1).friction),
  };
  const output = interactive.outcome(home);

  function part(ends, least, most) {
    const found = between(ends, least, most);
    return found.length ? `${number(share(found), 1)} % of ${found.length}` : "there are none";
  }

  function update() {
    const chosen = data.cases.find((shown) =>
      Object.entries(selects).every(([key, input]) => String(shown[key]) === input.value));
    const ends = [...chosen.opened], needed = chosen.friction / data.gear;
    draw(ends, needed);
    const name = `${data.arms[chosen.arm]}, run ${chosen.run}, friction ${chosen.friction} N m`;
    const end = `${chosen.film_opened ? "is open" : "is not open"} after ${chosen.steps} of at ` +
      `most ${data.max_steps} steps`;
    output.textContent = `${name}: opens ${number(share(ends), 1)} % of ${ends.length} doors. ` +
      `Where one motor is too weak (lever arms up to ${number(needed, 2)} m): ` +
      `${part(ends, 0, needed)}; beyond: ${part(ends, needed, Infinity)}. In the film, a door of ` +
      `lever arm ${number(data.levers[data.filmed], 2)} m ${end}.`;
    film.src = chosen.film;
    film.setAttribute("aria-label", `Film of the hook at the handle. ${name}: the door ${end}.`);
    svg.setAttribute("aria-label", "Doors, opened or not, and the part that is opened, by lever " +
      "arm. " + output.textContent);
  }
  for (const input of Object.values(selects)) input.addEventListener("input", update);
  update();
})();
