"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const root = document.documentElement;
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  const FONT = '12px system-ui, "Noto Sans", Arial, sans-serif';
  const element = (name, parent, text) => {
    const made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  };
  const digits = (value) => {
    if (value == null || !isFinite(value)) return "–";
    const size = Math.abs(value);
    if (size === 0) return "0";
    if (size < 1e5 && size >= 1e-3) return String(+value.toPrecision(4));
    const [mantissa, exponent] = value.toExponential(3).split("e");
    return `${Number(mantissa)}e${Number(exponent)}`;
  };
  const labelled = (axis) => (axis.unit ? `${axis.label} [${axis.unit}]` : axis.label);
  const colour = (index) => css(`--c${index % 6}`);
  const faint = (paint, share) => paint + Math.round(2.55 * share).toString(16).padStart(2, "0");

  // Every figure that is drawn, so that a new width, theme or page can draw it again.
  const drawn = [];
  const widthOf = (div) => Math.max(240, Math.floor(div.clientWidth));

  // Marks across a figure: limits, boundaries, values that the text names.
  const drawMarks = (u, marks) => {
    const { ctx, bbox } = u;
    const scale = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.font = `${11 * scale}px system-ui, "Noto Sans", Arial, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    const labels = [];
    for (const mark of marks) {
      const at = u.valToPos(mark.at, mark.vertical ? "x" : "y", true);
      ctx.strokeStyle = mark.limit ? css("--limit") : css("--ink2");
      ctx.fillStyle = ctx.strokeStyle;
      ctx.lineWidth = scale;
      ctx.setLineDash([5 * scale, 4 * scale]);
      ctx.beginPath();
      if (mark.vertical) {
        if (at < bbox.left - 1 || at > bbox.left + bbox.width + 1) continue;
        ctx.moveTo(at, bbox.top);
        ctx.lineTo(at, bbox.top + bbox.height);
      } else {
        if (at < bbox.top - 1 || at > bbox.top + bbox.height + 1) continue;
        ctx.moveTo(bbox.left, at);
        ctx.lineTo(bbox.left + bbox.width, at);
      }
      ctx.stroke();
      if (mark.label) labels.push({ mark, at, width: ctx.measureText(mark.label).width });
    }
    // Each label takes the first of its places that no other label has; those of horizontal lines have fewer of them.
    const taken = [];
    const end = bbox.left + bbox.width;
    for (const { mark, at, width } of labels.sort((one, other) => Boolean(one.mark.vertical) - Boolean(other.mark.vertical))) {
      const places = [];
      if (mark.vertical) {
        const sides = [at + 4 * scale, at - 4 * scale - width].filter((left) => left >= bbox.left && left + width <= end);
        const rows = Math.max(1, Math.floor(bbox.height / (14 * scale)));
        for (let row = 0; row < rows; row++) {
          for (const left of sides.length ? sides : [end - width]) places.push([left, bbox.top + (13 + 14 * row) * scale]);
        }
      } else {
        const base = at - 4 * scale < bbox.top + 10 * scale ? at + 12 * scale : at - 4 * scale;
        for (const left of [end - width - 4 * scale, bbox.left + (bbox.width - width) / 2, bbox.left + 4 * scale]) {
          places.push([left, base]);
        }
      }
      const box = ([left, base]) => [left - 2 * scale, base - 10 * scale, left + width + 2 * scale, base + 3 * scale];
      const isFree = (place) => {
        const [left, top, right, bottom] = box(place);
        return taken.every((other) => right <= other[0] || left >= other[2] || bottom <= other[1] || top >= other[3]);
      };
      const [left, base] = places.find(isFree) || places[0];
      taken.push(box([left, base]));
      ctx.globalAlpha = 0.7;
      ctx.fillStyle = css("--paper");
      ctx.fillRect(left - 2 * scale, base - 10 * scale, width + 4 * scale, 13 * scale);
      ctx.globalAlpha = 1;
      ctx.fillStyle = mark.limit ? css("--limit") : css("--ink2");
      ctx.fillText(mark.label, left, base);
    }
    ctx.restore();
  };

  const axisOf = (spec, extra) => Object.assign({
    label: labelled(spec), labelFont: FONT, labelSize: 20, font: FONT,
    stroke: () => css("--ink2"),
    grid: { stroke: () => css("--line"), width: 1 },
    ticks: { stroke: () => css("--line"), width: 1 },
    // On a logarithmic axis only the powers of ten have room for a number.
    values: (u, splits, axis) => splits.map((value) => {
      const isCrowded = u.scales[axis === 0 ? "x" : "y"].distr === 3 && Math.abs(Math.log10(value) % 1) > 1e-9;
      return value == null || isCrowded ? "" : digits(value);
    }),
  }, extra);
  // Room for the longest number beside the axis.
  const widthOfValues = (u, values, axis, cycle) => {
    if (cycle > 1) return u.axes[axis]._size;
    const longest = Math.max(0, ...(values || []).map((text) => text.length));
    return Math.max(44, 24 + 7 * longest);
  };
  const WHOLE = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000];

  const seriesOf = (series, y) => {
    const paint = () => colour(series.colour);
    const made = {
      label: series.name, scale: "y", stroke: paint, spanGaps: series.style !== "dots" && series.spans,
      value: (u, value) => (value == null ? "–" : `${digits(value)}${y.unit ? " " + y.unit : ""}`),
    };
    if (series.style === "dots") {
      return Object.assign(made, { paths: () => null, width: 0, points: { show: true, size: 5, fill: paint, stroke: paint } });
    }
    if (series.style === "bars") {
      return Object.assign(made, { width: 1, points: { show: false }, fill: () => faint(colour(series.colour), 60),
        paths: uPlot.paths.bars({ size: [0.95, 100] }) });
    }
    if (series.style === "steps") {
      return Object.assign(made, { width: 2, points: { show: false }, paths: uPlot.paths.stepped({ align: 1 }), dash: [] });
    }
    if (series.style === "edge") return Object.assign(made, { width: 0, points: { show: false }, stroke: () => faint(paint(), 50) });
    return Object.assign(made, {
      width: 2, points: { show: series.style === "line_and_dots", size: 6, fill: paint, stroke: paint },
      dash: series.style === "dashed" ? [8, 5] : [],
    });
  };

  const makeChart = (div, spec, options) => {
    const marks = spec.marks || [];
    const xScale = { time: false, distr: spec.logarithmic ? 3 : 1, log: 10 };
    if (spec.x_range) xScale.range = (u, low, high) => (u.zoomed ? [low, high] : spec.x_range);
    const yScale = spec.y_range ? { range: spec.y_range } : {};
    if (spec.y_logarithmic) Object.assign(yScale, { distr: 3, log: 10 });
    const config = {
      width: widthOf(div), height: spec.height || 260,
      scales: { x: xScale, y: yScale },
      axes: [
        axisOf(spec.x, { size: 34, incrs: spec.whole ? WHOLE : undefined, space: spec.whole ? 30 : 60 }),
        axisOf(spec.y, { size: widthOfValues, scale: "y" }),
      ],
      series: [{ label: labelled(spec.x), value: (u, value) => digits(value) }].concat(spec.series.map((it) => seriesOf(it, spec.y))),
      bands: (spec.bands || []).map((band) => ({
        series: [band.upper + 1, band.lower + 1], fill: () => faint(colour(band.colour), 22),
      })),
      legend: { live: true, markers: { width: 2 } },
      cursor: Object.assign({ drag: { x: true, y: false }, points: { size: 6 } }, options && options.cursor),
      hooks: {
        draw: [(u) => drawMarks(u, marks)],
        setSelect: [(u) => { u.zoomed = true; }],
        ready: [(u) => { u.over.addEventListener("dblclick", () => { u.zoomed = false; }); }],
      },
    };
    const plot = new uPlot(config, [spec.xs].concat(spec.series.map((it) => it.values)), div);
    drawn.push({
      redraw: () => plot.redraw(false),
      resize: (width) => plot.setSize({ width: width || widthOf(div), height: config.height }),
    });
    return plot;
  };

  // A colour scale from dark to light that colour-blind people can read: five colours of "viridis".
  const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const heat = (share) => {
    const place = Math.min(0.9999, Math.max(0, share)) * (SCALE.length - 1);
    const [low, high] = [SCALE[Math.floor(place)], SCALE[Math.floor(place) + 1]];
    const mixed = low.map((value, index) => Math.round(value + (high[index] - value) * (place % 1)));
    return `rgb(${mixed.join(",")})`;
  };

  const drawMap = (canvas, map) => {
    const width = Math.min(640, Math.max(240, canvas.parentElement.clientWidth));
    const height = Math.round(width * 0.72);
    const scale = devicePixelRatio;
    canvas.width = width * scale;
    canvas.height = height * scale;
    const ctx = canvas.getContext("2d");
    ctx.scale(scale, scale);
    const box = { left: 76, top: 12, width: width - 76 - 78, height: height - 12 - 46 };
    const low = Math.min(...map.values), high = Math.max(...map.values);
    const share = (value) => (value - low) / (high - low || 1);
    const [columns, rows] = [map.xs.length, map.ys.length];
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        ctx.fillStyle = heat(share(map.values[row * columns + column]));
        ctx.fillRect(box.left + column * box.width / columns, box.top + (rows - 1 - row) * box.height / rows,
          box.width / columns + 0.6, box.height / rows + 0.6);
      }
    }
    const x = (value) => box.left + box.width * (value - map.xs[0]) / (map.xs[columns - 1] - map.xs[0]);
    const y = (value) => box.top + box.height * (1 - (value - map.ys[0]) / (map.ys[rows - 1] - map.ys[0]));
    for (const point of map.points) {
      ctx.beginPath();
      ctx.arc(x(point[0]), y(point[1]), 4, 0, 7);
      ctx.fillStyle = "#ffffff";
      ctx.strokeStyle = "#000000";
      ctx.fill();
      ctx.stroke();
    }
    ctx.lineWidth = 3;
    for (const [paint, wide] of [["#000000", 5], ["#ffffff", 2]]) {
      ctx.strokeStyle = paint;
      ctx.lineWidth = wide;
      ctx.beginPath();
      for (const [dx, dy] of [[-6, -6], [-6, 6]]) {
        ctx.moveTo(x(map.best[0]) + dx, y(map.best[1]) + dy);
        ctx.lineTo(x(map.best[0]) - dx, y(map.best[1]) - dy);
      }
      ctx.stroke();
    }
    ctx.fillStyle = css("--ink2");
    ctx.strokeStyle = css("--ink2");
    ctx.lineWidth = 1;
    ctx.font = FONT;
    ctx.textAlign = "center";
    for (const part of [0, 0.5, 1]) {
      const value = map.xs[0] + part * (map.xs[columns - 1] - map.xs[0]);
      ctx.textAlign = ["left", "center", "right"][part * 2];
      ctx.fillText(digits(value), x(value), box.top + box.height + 16);
    }
    ctx.textAlign = "center";
    ctx.fillText(labelled(map.x), box.left + box.width / 2, height - 8);
    ctx.textAlign = "right";
    for (const part of [0, 0.5, 1]) {
      const value = map.ys[0] + part * (map.ys[rows - 1] - map.ys[0]);
      ctx.fillText(digits(value), box.left - 6, y(value) + 4 + (part === 1 ? 6 : part === 0 ? -4 : 0));
    }
    ctx.save();
    ctx.translate(13, box.top + box.height / 2);
    ctx.rotate(-Math.PI / 2);
    ctx.textAlign = "center";
    ctx.fillText(labelled(map.y), 0, 0);
    ctx.restore();
    const bar = box.left + box.width + 12;
    for (let step = 0; step < 100; step++) {
      ctx.fillStyle = heat(1 - step / 99);
      ctx.fillRect(bar, box.top + step * box.height / 100, 14, box.height / 100 + 0.6);
    }
    ctx.fillStyle = css("--ink2");
    ctx.textAlign = "left";
    ctx.fillText(digits(high), bar + 18, box.top + 10);
    ctx.fillText(digits(low), bar + 18, box.top + box.height);
    ctx.save();
    ctx.translate(bar + 32, box.top + box.height / 2);
    ctx.rotate(-Math.PI / 2);
    ctx.textAlign = "center";
    ctx.fillText(labelled(map.value), 0, 0);
    ctx.restore();
  };

  // Numbers as 16-bit integers in base64; the smallest one means "no value".
  const unpack = (text, unit) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, index) => {
      const value = view.getInt16(2 * index, true);
      return value === -32768 ? null : value * unit;
    });
  };

  // A Furuta pendulum seen from the front and a little from above.
  const drawPendulum = (ctx, place, title, sides, theta, alpha, paint) => {
    const tilt = 0.42;
    // Everything that arm and pendulum can reach has room.
    const [arm, pendulum] = [Math.max(sides.arm, 0.01), Math.max(sides.pendulum, 0.01)];
    const unit = Math.min((0.5 * place.width - 8) / Math.hypot(arm, pendulum),
      (0.48 * place.height - 8) / (arm * Math.sin(tilt) + pendulum * Math.cos(tilt)));
    const centre = [place.left + place.width / 2, place.top + place.height * 0.52];
    const flat = ([x, y, z]) => [centre[0] + unit * y, centre[1] + unit * (x * Math.sin(tilt) - z * Math.cos(tilt))];
    const line = (from, to, width, stroke) => {
      ctx.beginPath();
      ctx.moveTo(...flat(from));
      ctx.lineTo(...flat(to));
      ctx.lineWidth = width;
      ctx.strokeStyle = stroke;
      ctx.lineCap = "round";
      ctx.stroke();
    };
    ctx.font = FONT;
    ctx.textAlign = "center";
    ctx.fillStyle = css("--ink2");
    ctx.fillText(title, centre[0], place.top + 16);
    const reach = sides.arm;
    ctx.beginPath();
    for (let step = 0; step <= 60; step++) {
      const angle = -sides.limit + 2 * sides.limit * step / 60;
      ctx[step ? "lineTo" : "moveTo"](...flat([reach * Math.cos(angle), reach * Math.sin(angle), 0]));
    }
    ctx.lineWidth = 1;
    ctx.strokeStyle = css("--line");
    ctx.stroke();
    for (const end of [-sides.limit, sides.limit]) {
      line([0.88 * reach * Math.cos(end), 0.88 * reach * Math.sin(end), 0],
        [1.12 * reach * Math.cos(end), 1.12 * reach * Math.sin(end), 0], 2, css("--limit"));
    }
    line([0, 0, -0.9 * reach], [0, 0, 0], 8, css("--line"));
    if (theta == null || alpha == null) {
      ctx.fillText("no value at this time", centre[0], centre[1] + 14);
      return;
    }
    const tip = [reach * Math.cos(theta), reach * Math.sin(theta), 0];
    const swing = sides.pendulum * Math.sin(alpha);
    const end = [tip[0] - swing * Math.sin(theta), tip[1] + swing * Math.cos(theta), -sides.pendulum * Math.cos(alpha)];
    line([0, 0, 0], tip, 6, css("--ink2"));
    line(tip, end, 5, paint);
    ctx.beginPath();
    ctx.arc(...flat(end), 6, 0, 7);
    ctx.fillStyle = paint;
    ctx.fill();
  };

  const makePlayer = (div) => {
    const motions = data.motions;
    if (!motions.length) return;
    div.textContent = "";
    const top = element("div", div);
    top.className = "controls";
    const chooser = element("select", top);
    chooser.setAttribute("aria-label", "rollout");
    let group = null;
    motions.forEach((motion, index) => {
      if (!group || group.label !== motion.group) {
        group = element("optgroup", chooser);
        group.label = motion.group;
      }
      const option = element("option", group, motion.name);
      option.value = index;
    });
    const note = element("p", div);
    note.className = "facts";
    const scene = element("canvas", div);
    scene.className = "scene";
    scene.setAttribute("role", "img");
    scene.setAttribute("aria-label", "the pendulum of the chosen rollout; the figures below show its angles");
    const bar = element("div", div);
    bar.className = "controls";
    const play = element("button", bar, "▶ Play");
    const scrub = element("input", bar);
    scrub.type = "range";
    scrub.min = 0;
    scrub.setAttribute("aria-label", "time in the rollout");
    const speed = element("select", bar);
    speed.setAttribute("aria-label", "speed");
    for (const [name, factor] of [["full speed", 1], ["half speed", 0.5], ["a quarter", 0.25], ["a tenth", 0.1]]) {
      element("option", speed, name).value = factor;
    }
    const now = element("p", div);
    now.className = "now";
    const plots = element("div", div);
    let shown = null, place = 0, playing = false, last = 0, from = drawn.length;

    const drawScene = () => {
      const width = Math.max(240, scene.clientWidth);
      const two = shown.simTheta && width >= 480;
      const height = Math.min(360, Math.round(two ? width * 0.42 : width * 0.8));
      const scale = devicePixelRatio;
      scene.height = height * scale;
      scene.width = width * scale;
      scene.style.height = `${height}px`;
      const ctx = scene.getContext("2d");
      ctx.scale(scale, scale);
      const half = two ? width / 2 : width;
      const { theta, alpha, simTheta, simAlpha, sides } = shown;
      drawPendulum(ctx, { left: 0, top: 0, width: half, height }, "recorded", sides, theta[place], alpha[place], css("--c0"));
      if (two) {
        drawPendulum(ctx, { left: half, top: 0, width: half, height }, "simulated", sides, simTheta[place], simAlpha[place], css("--c1"));
      }
    };
    const show = () => {
      place = Math.max(0, Math.min(shown.times.length - 1, place));
      drawScene();
      scrub.value = place;
      const value = (numbers, unit) => `${numbers[place] == null ? "–" : numbers[place].toFixed(2)} ${unit}`;
      const phase = shown.phases.filter((it) => it.from <= place).pop();
      now.textContent = `${shown.times[place].toFixed(2)} s · ${phase ? phase.name + " · " : ""}θ ${value(shown.theta, "rad")} · ` +
        `α ${value(shown.alpha, "rad")} · ${value(shown.voltage, "V")}`;
      for (const { plot, head } of shown.plots) head.style.left = `${plot.valToPos(shown.times[place], "x")}px`;
    };
    const choose = (index) => {
      const motion = motions[index];
      drawn.length = from;
      plots.textContent = "";
      const theta = unpack(motion.theta, 0.001), alpha = unpack(motion.alpha, 0.001), voltage = unpack(motion.voltage, 0.001);
      const times = theta.map((_, step) => motion.first_s + step * motion.step_s);
      const simTheta = motion.simulated_theta && unpack(motion.simulated_theta, 0.001);
      const simAlpha = motion.simulated_alpha && unpack(motion.simulated_alpha, 0.001);
      shown = { times, theta, alpha, voltage, simTheta, simAlpha, phases: motion.phases, plots: [],
        sides: { arm: motion.arm_m || 0.1, pendulum: motion.pendulum_m || 0.1, limit: Math.min(motion.limits.theta_rad || 0, 3.2) } };
      note.textContent = motion.note;
      scrub.max = times.length - 1;
      const boundaries = motion.phases.filter((phase) => phase.from > 0)
        .map((phase) => ({ at: times[phase.from], vertical: true, label: phase.name }));
      const nearest = motion.nearest.map((it) => ({ at: it.time_s, vertical: true, label: it.label, limit: true, of: it.of }));
      const limit = (value, name) => [value, -value].map((at) => ({ at, label: `${name} ${digits(at)}`, limit: true }));
      const of = (quantity) => boundaries.concat(nearest.filter((it) => it.of === quantity));
      const angle = (name, recorded, simulated, quantity, limits) => ({
        x: { label: "time", unit: "s" }, y: { label: name, unit: "rad" }, xs: times, height: 200,
        series: [{ name: "recorded", values: recorded, style: "line", colour: 0 }]
          .concat(simulated ? [{ name: "simulated", values: simulated, style: "dashed", colour: 1 }] : []),
        marks: of(quantity).concat(limits),
      });
      const sync = { cursor: { sync: { key: "motion" } } };
      const clip = (numbers, most) => numbers && numbers.map((it) => (it == null || Math.abs(it) > most ? null : it));
      const specs = [
        angle("θ, the arm", theta, clip(simTheta, 2 * motion.limits.theta_rad), "theta", limit(motion.limits.theta_rad, "limit")),
        angle("α, the pendulum", alpha, clip(simAlpha, 2 * motion.limits.alpha_rad), "alpha",
          [{ at: Math.PI, label: "upright" }, { at: -Math.PI, label: "upright" }].concat(limit(motion.limits.alpha_rad, "limit"))),
        { x: { label: "time", unit: "s" }, y: { label: "voltage", unit: "V" }, xs: times, height: 170,
          series: [{ name: "sent", values: voltage, style: "steps", colour: 2 }],
          marks: boundaries.concat(limit(motion.limits.voltage_v, "largest")) },
      ];
      const room = (spec, most) => {
        const all = spec.series.flatMap((it) => it.values).filter((it) => it != null);
        const low = Math.min(0, ...all), high = Math.max(0, ...all);
        const [bottom, peak] = [low < -0.55 * most ? Math.min(low, -1.05 * most) : low, high > 0.55 * most ? Math.max(high, 1.05 * most) : high];
        const margin = 0.08 * (peak - bottom) + 0.05;
        spec.y_range = [bottom - margin, peak + margin];
      };
      room(specs[0], motion.limits.theta_rad);
      room(specs[1], motion.limits.alpha_rad);
      room(specs[2], motion.limits.voltage_v);
      for (const spec of specs) {
        const plot = makeChart(element("div", plots), spec, sync);
        const head = element("div", plot.over);
        head.className = "playhead";
        plot.over.addEventListener("click", () => {
          if (plot.cursor.idx != null) { place = plot.cursor.idx; show(); }
        });
        shown.plots.push({ plot, head });
      }
      drawn.push({ redraw: show, resize: show });
      const running = motion.phases.find((phase) => phase.name === "policy");
      place = running ? running.from : 0;
      show();
    };
    const stop = () => { playing = false; play.textContent = "▶ Play"; };
    const step = (time) => {
      if (!playing) return;
      const seconds = (time - last) / 1000 * Number(speed.value);
      const steps = Math.floor(seconds / motions[chooser.value].step_s);
      if (steps > 0) {
        last = time;
        place += steps;
        if (place >= shown.times.length - 1) stop();
        show();
      }
      requestAnimationFrame(step);
    };
    play.addEventListener("click", () => {
      if (playing) return stop();
      playing = true;
      play.textContent = "⏸ Pause";
      if (place >= shown.times.length - 1) place = 0;
      last = performance.now();
      requestAnimationFrame(step);
    });
    scrub.addEventListener("input", () => { place = Number(scrub.value); show(); });
    chooser.addEventListener("change", () => { stop(); choose(Number(chooser.value)); });
    chooser.value = data.first_motion;
    choose(data.first_motion);
  };

  for (const div of document.querySelectorAll("[data-chart]")) {
    makeChart(div, data.charts[Number(div.dataset.chart)]);
  }
  for (const canvas of document.querySelectorAll("[data-map]")) {
    const again = () => drawMap(canvas, data.maps[Number(canvas.dataset.map)]);
    again();
    drawn.push({ redraw: again, resize: again });
  }
  const player = document.querySelector("[data-player]");
  if (player) makePlayer(player);

  for (const details of document.querySelectorAll("details")) details.addEventListener("toggle", () => resize());

  const redraw = () => drawn.forEach((it) => it.redraw());
  const resize = () => drawn.forEach((it) => it.resize());
  let pending = 0;
  addEventListener("resize", () => { cancelAnimationFrame(pending); pending = requestAnimationFrame(resize); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  // On paper the page is as wide as a sheet, and light.
  const onPaper = (is) => () => {
    if (is) root.dataset.print = "1"; else delete root.dataset.print;
    resize();
    redraw();
  };
  addEventListener("beforeprint", onPaper(true));
  addEventListener("afterprint", onPaper(false));
  root.dataset.drawn = "1";
})();
