//! [`ClipShape`] and [`Dims`]: what a session is made for, and its token counts.
//!
//! The ground of every stage: checked once against the network and the caps, trusted afterwards.

use sf_formats::config::ModelConfig;
use sf_formats::{Error, Result};
use sf_ops::attention::FrameMask;

/// Most frames of a clip.
pub const MAX_FRAMES: usize = 4096;
/// Most tokens of a clip.
pub const MAX_TOKENS: usize = 1 << 22;
/// Most pixels of a clip.
pub const MAX_PIXELS: usize = 1 << 30;
/// What a session is made for: frames of one size, multiples of the patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipShape {
    /// Frames of the clip.
    pub frames: usize,
    /// Pixels.
    pub height: usize,
    /// Pixels.
    pub width: usize,
}

/// Token counts of a clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Dims {
    pub(crate) frames: usize,
    pub(crate) height: usize,
    pub(crate) width: usize,
    /// Patch grid.
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    pub(crate) patches: usize,
    /// Encoder tokens per frame: class, registers, patches.
    pub(crate) encoder_tokens: usize,
    /// Aggregator tokens per frame: registers, patches.
    pub(crate) tokens: usize,
}

impl Dims {
    /// Checks a clip shape against the network and the caps; after this no size overflows 64 bits.
    pub(crate) fn new(config: &ModelConfig, shape: ClipShape) -> Result<Dims> {
        let ClipShape { frames, height, width } = shape;
        let patch = config.patch as usize;
        if frames == 0 {
            return Err(Error::usage("a clip needs at least one frame"));
        }
        if height == 0 || width == 0 || height % patch != 0 || width % patch != 0 {
            return Err(Error::input(
                "clip",
                format!("network size {width}x{height} must be a multiple of {patch} both ways: resize the frames"),
            ));
        }
        let over = |what: &str, have: usize, limit: usize| {
            Err(Error::resource(
                "plan",
                format!(
                    "{have} {what} in the clip, at most {limit}: use fewer or smaller frames, or windows of the clip"
                ),
            ))
        };
        if frames > MAX_FRAMES {
            return over("frames", frames, MAX_FRAMES);
        }
        let pixels = height.checked_mul(width).and_then(|p| p.checked_mul(frames)).unwrap_or(usize::MAX);
        if pixels > MAX_PIXELS {
            return over("pixels", pixels, MAX_PIXELS);
        }
        let (rows, cols) = (height / patch, width / patch);
        let patches = rows * cols;
        let tokens = patches + config.aa.registers as usize;
        let encoder_tokens = 1 + config.encoder.registers as usize + patches;
        let all = frames * tokens.max(encoder_tokens);
        if all > MAX_TOKENS {
            return over("tokens", all, MAX_TOKENS);
        }
        Ok(Dims { frames, height, width, rows, cols, patches, encoder_tokens, tokens })
    }

    pub(crate) fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// Every token sees its own frame.
    pub(crate) fn frame_mask(&self, tokens: usize) -> FrameMask {
        FrameMask { frames: self.frames, tokens, lo: 0, hi: 0 }
    }

    /// Every token sees every frame.
    pub(crate) fn global_mask(&self) -> FrameMask {
        let reach = self.frames as i32 - 1;
        FrameMask { frames: self.frames, tokens: self.tokens, lo: -reach, hi: reach }
    }
}
