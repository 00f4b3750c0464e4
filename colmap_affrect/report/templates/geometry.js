"use strict";
// How the cameras of a model see it, without anything on the page.
page.geometry = (() => {
  const NEAREST = 1e-3; // of what is before a camera, in radii of the view
  const NUM_STEPS = 20; // until a place without distortion is found
  const [NEAR, FAR, NUM_DEPTHS] = [0.02, 100, 120]; // of a line of sight, in radii of the view
  const MIN_ANGLE = 0.01; // radians between two lines of sight, whose meeting is known

  // px of the photograph and depth, by a place of the model; NaN where the camera does not see it.
  function projector({ rotation, center, focal, axis, radial, size }) {
    const [r0, r1, r2, r3, r4, r5, r6, r7, r8] = rotation;
    const farthest = 2 * Math.hypot(size[0] / focal[0], size[1] / focal[1]);
    return (x, y, z) => {
      const [dx, dy, dz] = [x - center[0], y - center[1], z - center[2]];
      const depth = r6 * dx + r7 * dy + r8 * dz;
      if (depth < NEAREST) return [NaN, NaN, depth];
      const u = (r0 * dx + r1 * dy + r2 * dz) / depth;
      const v = (r3 * dx + r4 * dy + r5 * dz) / depth;
      const squared = u * u + v * v;
      if (squared > farthest * farthest) return [NaN, NaN, depth];
      const scale = 1 + squared * (radial[0] + squared * radial[1]);
      return [focal[0] * u * scale + axis[0], focal[1] * v * scale + axis[1], depth];
    };
  }

  // The direction in the model, of length 1, in which a place of a photograph in px is seen.
  function ray({ rotation, focal, axis, radial }, x, y) {
    const seen = [(x - axis[0]) / focal[0], (y - axis[1]) / focal[1]];
    let [u, v] = seen;
    for (let step = 0; step < NUM_STEPS; step++) {
      const squared = u * u + v * v;
      const scale = 1 + squared * (radial[0] + squared * radial[1]);
      [u, v] = [seen[0] / scale, seen[1] / scale];
    }
    const length = Math.hypot(u, v, 1);
    return [0, 1, 2].map((row) => (rotation[row] * u + rotation[row + 3] * v + rotation[row + 6]) / length);
  }

  const determinant = ([a, b, c], [d, e, f], [g, h, i]) =>
    a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);

  // The place next to all lines of sight; null where these are as good as parallel.
  function meeting(sights) {
    const rays = sights.map(({ look, x, y }) => ray(look, x, y));
    const cosines = rays.map((one) => Math.abs(one[0] * rays[0][0] + one[1] * rays[0][1] + one[2] * rays[0][2]));
    if (Math.acos(Math.min(1, ...cosines)) < MIN_ANGLE) return null;
    const matrix = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
    const right = [0, 0, 0];
    sights.forEach(({ look }, index) => {
      const direction = rays[index];
      for (let row = 0; row < 3; row++) {
        for (let column = 0; column < 3; column++) {
          const value = (row === column) - direction[row] * direction[column];
          matrix[row][column] += value;
          right[row] += value * look.center[column];
        }
      }
    });
    const whole = determinant(...matrix);
    return [0, 1, 2].map((column) => {
      const changed = matrix.map((row, index) =>
        row.map((value, at) => (at === column ? right[index] : value)));
      return determinant(...changed) / whole;
    });
  }

  // Where a photograph sees the line of sight of another one: places in px, the nearest first.
  function epipolarLine({ look, x, y }, other) {
    const direction = ray(look, x, y);
    const project = projector(other);
    const places = [];
    for (let step = 0; step < NUM_DEPTHS; step++) {
      const depth = NEAR * (FAR / NEAR) ** (step / (NUM_DEPTHS - 1));
      const [u, v] = project(...look.center.map((value, axis) => value + depth * direction[axis]));
      if (Number.isFinite(u)) places.push([u, v]);
    }
    return places;
  }

  return { projector, meeting, epipolarLine };
})();
