//! Registry kinds whose settings live in rooms that know no registry.

use crate::decoding::DecodingSettings;
use crate::evaluation::published::Published;
use crate::evaluation::suite::Suite;
use crate::experiment::{Kind, KindEntry};
use crate::masking::MaskingSettings;
use crate::mget::Size;

impl Kind for DecodingSettings {
    const KIND: &'static str = "decoding";
    const ABOUT: &'static str = "How tokens are generated: order, steps, guidance, filters.";
}
inventory::submit! { KindEntry::of::<DecodingSettings>() }

impl Kind for Suite {
    const KIND: &'static str = "suite";
    const ABOUT: &'static str = "What an evaluation computes, and on which clips.";
}
inventory::submit! { KindEntry::of::<Suite>() }

impl Kind for Published {
    const KIND: &'static str = "published";
    const ABOUT: &'static str =
        "Rows of published tables with their conditions: context, never compared.";
}
inventory::submit! { KindEntry::of::<Published>() }

impl Kind for MaskingSettings {
    const KIND: &'static str = "masking";
    const ABOUT: &'static str = "Which tokens are inputs, and which are targets.";
}
inventory::submit! { KindEntry::of::<MaskingSettings>() }

impl Kind for Size {
    const KIND: &'static str = "size";
    const ABOUT: &'static str = "Depth and width of MGET.";
}
inventory::submit! { KindEntry::of::<Size>() }
