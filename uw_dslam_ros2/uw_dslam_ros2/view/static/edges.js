// Constraints: how they are drawn, and what is said of them.
const GOOD_M = 0.3; // a constraint that is left with more than this is drawn as one that pulls

/** Each kind with its line and its words; the first that fits is an edge's own. */
const KINDS = [
  { fits: (edge) => edge.kind === "confirmed", words: "confirmed by a person", line: { color: "#5b2a86", weight: 4, dashArray: "12 4 2 4" } },
  { fits: (edge) => !edge.is_inlier, words: "taken out: it contradicts the others", line: { color: "#cc2800", weight: 2, dashArray: "2 5" } },
  { fits: (edge) => edge.is_unsure, words: "refused by itself, believed because others agree", line: { color: "#8a6d00", weight: 2.5, dashArray: "8 4" } },
  { fits: (edge) => edge.residual_m > GOOD_M, words: `holds, but pulls (over ${GOOD_M} m)`, line: { color: "#d55e00", weight: 2.5 } },
  { fits: () => true, words: "holds", line: { color: "#00704f", weight: 2.5 } },
];

export const ODOMETRY = { color: "#52606d", weight: 1 };

export function kind_of(edge) {
  return KINDS.find((kind) => kind.fits(edge));
}

/** Those that occur, in the order of the best first. */
export function kinds_in(constraints) {
  const matches = constraints.filter((edge) => edge.kind !== "odometry").map(kind_of);
  return [...KINDS].reverse().filter((kind) => matches.includes(kind));
}

export function told(edge) {
  const left = edge.residual_m === null ? "" : `, ${edge.residual_m.toFixed(2)} m and ${edge.residual_deg.toFixed(2)}° left`;
  return `${edge.source} – ${edge.target}: ${kind_of(edge).words}${left}`;
}
