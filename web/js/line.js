// The straight line of a test that is still going on. The final one comes from the server with the state's result.

/** Least squares through (x, y): {slope, intercept}, or null below two different x. */
export function line(xs, ys) {
  const n = xs.length;
  const mx = xs.reduce((a, b) => a + b, 0) / n;
  const my = ys.reduce((a, b) => a + b, 0) / n;
  let sxx = 0;
  let sxy = 0;
  for (let i = 0; i < n; i++) {
    sxx += (xs[i] - mx) ** 2;
    sxy += (xs[i] - mx) * (ys[i] - my);
  }
  return sxx > 0 ? { slope: sxy / sxx, intercept: my - (sxy / sxx) * mx } : null;
}

const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;

function bySetPoint(points, test) {
  const groups = new Map();
  for (const point of points) {
    if (point.test !== test) continue;
    if (!groups.has(point.set_point)) groups.set(point.set_point, { set_point: point.set_point, references: [], readings: [] });
    groups.get(point.set_point).references.push(point.reference);
    groups.get(point.set_point).readings.push(point.gyro);
  }
  return [...groups.values()]
    .map((group) => ({ ...group, reference: mean(group.references), mean: mean(group.readings) }))
    .sort((a, b) => a.reference - b.reference);
}

/** Points as they come, in the shape of a finished test: {linearity: […], repeat: […]}. */
export function soFar(points) {
  const linearity = bySetPoint(points, "linearity");
  const fit = linearity.length > 2 ? line(linearity.map((p) => p.reference), linearity.map((p) => p.mean)) : null;
  for (const point of linearity) {
    point.fit = fit ? fit.intercept + fit.slope * point.reference : null;
    point.residual = fit ? point.mean - point.fit : null;
  }
  return { linearity, repeat: bySetPoint(points, "repeat") };
}

/** Two standard uncertainties of a set-point's mean, from the scatter of its readings: the certificate's band. */
export function twoSigma(linearity) {
  const readings = linearity.reduce((n, p) => n + p.readings.length, 0);
  const freedom = readings - linearity.length;
  const squares = linearity.flatMap((p) => p.readings.map((value) => (value - p.mean) ** 2));
  return freedom > 0 ? 2 * Math.sqrt((squares.reduce((a, b) => a + b, 0) / freedom) * (linearity.length / readings)) : null;
}
