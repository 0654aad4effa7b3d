//! What a person looks at: the self-contained page that shows a reconstruction (one HTML file, no network, no server), and
//! pictures of what clips hold ([`contact`], [`paths`], both on a [`canvas`]); and the wearer drawn into their own video
//! ([`overlay`], [`movie`]).
//!
//! Read [`scene`] (what can be shown), then [`page`] (how it becomes one file). The page itself is `page/`: `page.html` with
//! `page.css`, and a script in three parts, `data.js` (manifest and blobs), `draw.js` (WebGL2), `main.js` (layers, cameras,
//! timeline, keyboard). `#t=1.5` in the address opens at a time, `#camera=first` with a camera, and `#selftest` makes the page
//! examine itself and write what it saw into the document.

pub mod canvas;
pub mod cloud;
pub mod contact;
pub mod depth_sheet;
pub mod movie;
pub mod overlay;
pub mod page;
pub mod paths;
pub mod scene;

pub use page::write_page;
pub use scene::{
    Badge, Certainty, DepthGrids, Drawing, Fact, Part, Scene, Track, VideoFrames, ViewError,
};
