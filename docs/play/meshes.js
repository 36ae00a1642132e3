// Unit meshes of MuJoCo's shapes: a list of triangles' corners, each a position and a normal.

/** Corners of a grid of quads: `at(u, v)` with u, v in [0, 1] gives [position, normal]. */
function grid(numU, numV, at) {
  const corners = [];
  for (let i = 0; i < numU; i++) {
    for (let j = 0; j < numV; j++) {
      const [a, b] = [i / numU, (i + 1) / numU];
      const [c, d] = [j / numV, (j + 1) / numV];
      for (const [u, v] of [[a, c], [b, c], [b, d], [a, c], [b, d], [a, d]]) corners.push(...at(u, v).flat());
    }
  }
  return corners;
}

const around = (u) => [Math.cos(2 * Math.PI * u), Math.sin(2 * Math.PI * u)];

export function plane({ quads }) {
  return grid(quads, quads, (u, v) => [[2 * u - 1, 2 * v - 1, 0], [0, 0, 1]]);
}

export function box({ quads }) {
  const faces = [0, 1, 2].flatMap((axis) => [-1, 1].map((side) => [axis, side]));
  return faces.flatMap(([axis, side]) =>
    grid(quads, quads, (u, v) => {
      const point = [0, 0, 0];
      const normal = [0, 0, 0];
      point[axis] = normal[axis] = side;
      point[(axis + 1) % 3] = side * (2 * u - 1); // so that corners run counterclockwise
      point[(axis + 2) % 3] = 2 * v - 1;
      return [point, normal];
    }),
  );
}

export function sphere({ slices, stacks }) {
  return grid(slices, stacks, (u, v) => {
    const [x, y] = around(u);
    const angle = Math.PI * (v - 0.5);
    const point = [x * Math.cos(angle), y * Math.cos(angle), Math.sin(angle)];
    return [point, point];
  });
}

export function openCylinder({ slices, stacks }) {
  return grid(slices, stacks, (u, v) => {
    const [x, y] = around(u);
    return [[x, y, 2 * v - 1], [x, y, 0]];
  });
}

export function cylinder(quality) {
  const cap = (side) =>
    grid(quality.slices, quality.quads, (u, v) => {
      const [x, y] = around(u);
      const radius = side > 0 ? 1 - v : v;
      return [[x * radius, y * radius, side], [0, 0, side]];
    });
  return [...openCylinder(quality), ...cap(1), ...cap(-1)];
}
