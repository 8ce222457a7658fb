// How the scripts of the view's page are checked: `./uw lint`, where npm is.
const browser = [
  "CSS", "EventSource", "L", "URLSearchParams", "clearTimeout", "document", "fetch", "localStorage",
  "matchMedia", "requestAnimationFrame", "setInterval", "setTimeout", "clearInterval", "window",
];

export default [
  { ignores: ["**/vendor/**"] },
  {
    files: ["**/*.js"],
    languageOptions: {
      ecmaVersion: 2022,
      sourceType: "module",
      globals: Object.fromEntries(browser.map((name) => [name, "readonly"])),
    },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      "array-callback-return": "error", "consistent-return": "error", eqeqeq: "error", "no-const-assign": "error",
      "no-dupe-keys": "error", "no-eval": "error", "no-implied-eval": "error", "no-param-reassign": "error",
      "no-redeclare": "error", "no-self-compare": "error", "no-shadow": "error", "no-undef": "error",
      "no-unreachable": "error", "no-unused-private-class-members": "error", "no-unused-vars": "error",
      "no-use-before-define": ["error", { functions: false, classes: false, variables: false }],
      "no-var": "error", "prefer-const": "error",
    },
  },
];
