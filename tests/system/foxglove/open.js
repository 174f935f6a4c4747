// Foxglove Studio as published, with a layout for what a mission's log holds. No account, no network.

const layout = {
  configById: {
    "map!track": { layer: "custom", customTileUrl: "", disabledTopics: [], followTopic: "/fix", topicColors: {}, zoomLevel: 16 },
    "ImageViewPanel!thumbnail": { cameraTopic: "/thumbnail", enabledMarkerTopics: [], synchronize: false, transformMarkers: false, smooth: true },
    "RosOut!log": { searchTerms: [], minLogLevel: 1, topicToRender: "/log" },
    "SourceInfo!topics": {},
  },
  layout: {
    direction: "row",
    first: { direction: "column", first: "map!track", second: "RosOut!log", splitPercentage: 50 },
    second: { direction: "column", first: "ImageViewPanel!thumbnail", second: "SourceInfo!topics", splitPercentage: 70 },
  },
  globalVariables: {},
  userNodes: {},
  playbackConfig: { speed: 1 },
};
const kept = new Map([["flight", {
  id: "flight",
  name: "Flight",
  permission: "CREATOR_WRITE",
  baseline: { data: layout, savedAt: new Date().toISOString() },
}]]);
const layoutStorage = {
  list: async () => [...kept.values()],
  get: async (_, id) => kept.get(id),
  put: async (_, one) => (kept.set(one.id, one), one),
  delete: async (_, id) => void kept.delete(id),
  importLayouts: async () => {},
};
const settings = new Map([
  ["colorScheme", "light"],
  ["timezone", "UTC"],
  ["ui.open-dialog-startup", false],
]);
const appConfiguration = {
  get: (key) => settings.get(key),
  set: async (key, value) => void settings.set(key, value),
  addChangeListener() {},
  removeChangeListener() {},
};
localStorage.setItem("studio.profile-data", JSON.stringify({ currentLayoutId: "flight" }));

initI18n().then(() => {
  const app = React.createElement(App, {
    appConfiguration,
    dataSources: [new McapLocalDataSourceFactory()],
    deepLinks: [location.href],
    enableGlobalCss: true,
    extensionLoaders: [],
    layoutStorage,
  });
  ReactDOM.render(app, document.getElementById("root"));
});
