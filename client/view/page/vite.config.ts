// Build of the page: fixed file names and no inline script or style, so that a host can embed the files and serve them under
// a strict content security policy, and so that equal sources give equal bytes.
import { defineConfig } from "vite";

const names = {
  entryFileNames: "[name].js",
  chunkFileNames: "[name].js",
  assetFileNames: "[name][extname]",
};

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    assetsInlineLimit: 0,
    modulePreload: false,
    chunkSizeWarningLimit: 1500,
    rollupOptions: { output: { ...names, entryFileNames: "page.js" } },
  },
  worker: {
    format: "es",
    rollupOptions: { output: { ...names, entryFileNames: "worker.js" } },
  },
});
