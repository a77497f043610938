// The figure map: colours, axes, colour bar, PV and RMS in the corner, a profile along a line that
// the viewer drags.
(() => {
  const LEFT = 70, TOP = 42, RIGHT = 84, BOTTOM = 34, PROFILE = 120, MIN_DRAG = 8;

  class FigureMap {
    constructor(canvas) {
      this.canvas = canvas;
      this.data = null;
      this.line = null; // ends in shares of the map's width, from its left upper corner
      this.listen();
      new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
      matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
      new MutationObserver(() => this.draw()).observe(document.body, { attributeFilter: ['class'] });
    }

    show(data) {
      this.data = data;
      this.picture = this.paint(data);
      this.draw();
    }

    // The map alone, a pixel for each value.
    paint({ size, steps, steps_most: most, colours }) {
      const picture = document.createElement('canvas');
      picture.width = picture.height = size;
      const context = picture.getContext('2d');
      steps.forEach((step, place) => {
        if (step === null) return;
        const shade = Math.min(colours.length - 1, Math.floor((colours.length * step) / most));
        context.fillStyle = colours[shade];
        context.fillRect(place % size, Math.floor(place / size), 1, 1);
      });
      return picture;
    }

    value(step) {
      const { low_um: low, high_um: high, steps_most: most } = this.data;
      return step === null ? null : low + ((high - low) * step) / most;
    }

    get side() {
      return Math.max(80, this.canvas.parentElement.clientWidth - LEFT - RIGHT);
    }

    draw() {
      if (!this.data) return;
      const { canvas, side, data } = this;
      const ratio = window.devicePixelRatio || 1;
      const width = canvas.parentElement.clientWidth;
      const height = TOP + side + BOTTOM + PROFILE;
      canvas.style.width = `${width}px`;
      canvas.style.height = `${height}px`;
      canvas.width = width * ratio;
      canvas.height = height * ratio;
      const pen = canvas.getContext('2d');
      pen.scale(ratio, ratio);
      pen.font = '12px system-ui, sans-serif';
      this.ink = getComputedStyle(canvas).color;
      pen.fillStyle = pen.strokeStyle = this.ink;
      pen.imageSmoothingEnabled = false;
      pen.textBaseline = 'middle';
      const figures = `PV ${this.digits(data.pv_um)} µm, RMS ${this.digits(data.rms_um)} µm`;
      this.text(pen, data.title, LEFT, 10, 'left');
      this.text(pen, figures, LEFT, 27, 'left');
      pen.drawImage(this.picture, LEFT, TOP, side, side);
      this.axes(pen);
      this.bar(pen);
      this.profile(pen);
    }

    digits(value) {
      return Number(value.toPrecision(3)).toString();
    }

    text(pen, words, x, y, align) {
      pen.textAlign = align;
      pen.fillText(words, x, y);
    }

    // In mm, or in radii where the mirror's size is not known.
    axes(pen) {
      const { side, data } = this;
      const radius = data.radius_mm || 1;
      const unit = data.radius_mm ? 'mm' : 'radii';
      [-1, 0, 1].forEach((share) => {
        const at = (side * (share + 1)) / 2;
        const label = `${share * radius}`;
        this.tick(pen, LEFT + at, TOP + side, 0, 4);
        this.text(pen, label, LEFT + at, TOP + side + 13, 'center');
        this.tick(pen, LEFT, TOP + side - at, -4, 0);
        this.text(pen, label, LEFT - 7, TOP + side - at, 'right');
      });
      this.text(pen, `x, ${unit} →`, LEFT + side / 2, TOP + side + 27, 'center');
      this.text(pen, 'y ↑', LEFT - 7, TOP + side * 0.3, 'right');
    }

    tick(pen, x, y, dx, dy) {
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(x + dx, y + dy);
      pen.stroke();
    }

    bar(pen) {
      const { side, data } = this;
      const x = LEFT + side + 14;
      const { colours } = data;
      const step = side / colours.length;
      colours.forEach((colour, place) => {
        pen.fillStyle = colour;
        pen.fillRect(x, TOP + side - (place + 1) * step, 12, step + 0.5);
      });
      pen.fillStyle = this.ink;
      const middle = (data.low_um + data.high_um) / 2;
      this.text(pen, this.digits(data.high_um), x + 16, TOP + 6, 'left');
      this.text(pen, this.digits(middle), x + 16, TOP + side / 2, 'left');
      this.text(pen, this.digits(data.low_um), x + 16, TOP + side - 6, 'left');
    }

    // Values along the line, nearest pixel.
    sample([x0, y0, x1, y1], count = 200) {
      const { size, steps } = this.data;
      return Array.from({ length: count }, (_, n) => {
        const share = n / (count - 1);
        const column = Math.floor((x0 + (x1 - x0) * share) * size);
        const row = Math.floor((y0 + (y1 - y0) * share) * size);
        const inside = column >= 0 && column < size && row >= 0 && row < size;
        return inside ? this.value(steps[row * size + column]) : null;
      });
    }

    profile(pen) {
      const { side, data } = this;
      const line = this.line || [0, 0.5, 1, 0.5];
      pen.save();
      pen.lineWidth = 1.5;
      pen.setLineDash([4, 3]);
      this.stroke(pen, [
        [LEFT + line[0] * side, TOP + line[1] * side],
        [LEFT + line[2] * side, TOP + line[3] * side],
      ]);
      pen.restore();
      const values = this.sample(line);
      const known = values.filter((value) => value !== null);
      if (!known.length) return;
      const low = Math.min(...known), high = Math.max(...known);
      const top = TOP + side + BOTTOM + 22, depth = PROFILE - 42;
      const place = (n, value) => [
        LEFT + (side * n) / (values.length - 1),
        top + depth * (high > low ? (high - value) / (high - low) : 0.5),
      ];
      this.text(pen, this.line ? 'profile along the line' : 'profile; drag on the map for another', LEFT, top - 12, 'left');
      this.text(pen, this.digits(high), LEFT - 7, top, 'right');
      this.text(pen, this.digits(low), LEFT - 7, top + depth, 'right');
      const length = Math.hypot(line[2] - line[0], line[3] - line[1]) * 2 * (data.radius_mm || 1);
      const unit = data.radius_mm ? 'mm' : 'radii';
      this.text(pen, `0`, LEFT, top + depth + 12, 'left');
      this.text(pen, `${this.digits(length)} ${unit}`, LEFT + side, top + depth + 12, 'right');
      let piece = [];
      values.forEach((value, n) => {
        if (value !== null) piece.push(place(n, value));
        if (value === null || n === values.length - 1) {
          this.stroke(pen, piece);
          piece = [];
        }
      });
    }

    stroke(pen, points) {
      if (points.length < 2) return;
      pen.beginPath();
      points.forEach(([x, y]) => pen.lineTo(x, y));
      pen.stroke();
    }

    listen() {
      const { canvas } = this;
      const at = (event) => {
        const box = canvas.getBoundingClientRect();
        const share = (value) => Math.min(1, Math.max(0, value));
        return [
          share((event.clientX - box.left - LEFT) / this.side),
          share((event.clientY - box.top - TOP) / this.side),
        ];
      };
      let start = null;
      canvas.addEventListener('pointerdown', (event) => {
        const box = canvas.getBoundingClientRect();
        if (event.clientY - box.top > TOP + this.side) return; // below the map a finger scrolls
        start = at(event);
        canvas.setPointerCapture(event.pointerId);
      });
      canvas.addEventListener('pointermove', (event) => {
        if (!start) return;
        const end = at(event);
        if (Math.hypot(end[0] - start[0], end[1] - start[1]) * this.side < MIN_DRAG) return;
        this.line = [...start, ...end];
        this.draw();
      });
      ['pointerup', 'pointercancel'].forEach((name) => canvas.addEventListener(name, () => (start = null)));
    }
  }

  const maps = new WeakMap();

  // Fetches the newest map and shows it in a canvas.
  window.membraneDrawMap = async (id, url) => {
    const answer = await fetch(window.path_prefix + url);
    if (!answer.ok) return;
    const canvas = document.getElementById(id);
    if (!maps.has(canvas)) maps.set(canvas, new FigureMap(canvas));
    maps.get(canvas).show(await answer.json());
  };
})();
