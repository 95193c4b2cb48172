//! The exact set of tensors a [`ModelConfig`] asks for, with public names and shapes.
//!
//! One list serves everything that must agree: seeded initialisation, checkpoint conversion, blob
//! validation and the engine's lookup. Names are Pi3's public names for what Pi3 has; ours are
//! `gs_*`, `causal.*`, `motion_*`, `aa_time` and `image_stem`, with VGGT's DPT names inside DPT heads.

use crate::config::{Head, HeadKind, KSource, ModelConfig, Trunk};

/// What a tensor is, which decides how it is stored and initialised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// `[out, in]` weight of a linear layer.
    Linear,
    /// `[out, in, kh, kw]` weight of a convolution.
    Conv,
    /// `[in, out, k, k]` weight of a transposed convolution with stride k.
    ConvTranspose,
    /// Bias of a linear layer or convolution.
    Bias,
    /// Gain of a norm.
    NormGain,
    /// Offset of a norm.
    NormOffset,
    /// Layer scale; 1 in the encoder, 0.01 elsewhere at the start of training.
    LayerScale,
    /// Learned tokens and the position table.
    Table,
}

/// One tensor of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorSpec {
    /// Public name.
    pub name: String,
    /// Shape in the checkpoint.
    pub shape: Vec<usize>,
    /// What it is.
    pub role: Role,
}

impl TensorSpec {
    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Never: every dimension is at least one.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// As a matrix product: `(outputs n, inputs k)` of the panels that hold it; `None` for vectors and
    /// tables. Convolutions order k as `[ky][kx][in]`; transposed ones order n as `[ky][kx][out]`.
    pub fn matrix(&self) -> Option<(usize, usize)> {
        let s = &self.shape;
        match self.role {
            Role::Linear => Some((s[0], s[1])),
            Role::Conv => Some((s[0], s[1] * s[2] * s[3])),
            Role::ConvTranspose => Some((s[1] * s[2] * s[3], s[0])),
            _ => None,
        }
    }
}

struct List(Vec<TensorSpec>);

impl List {
    fn push(&mut self, name: String, shape: &[u32], role: Role) {
        self.0.push(TensorSpec { name, shape: shape.iter().map(|&d| d as usize).collect(), role });
    }

    fn linear(&mut self, p: &str, out: u32, inp: u32) {
        self.push(format!("{p}.weight"), &[out, inp], Role::Linear);
        self.push(format!("{p}.bias"), &[out], Role::Bias);
    }

    fn conv(&mut self, p: &str, out: u32, inp: u32, k: u32, bias: bool) {
        self.push(format!("{p}.weight"), &[out, inp, k, k], Role::Conv);
        if bias {
            self.push(format!("{p}.bias"), &[out], Role::Bias);
        }
    }

    fn norm(&mut self, p: &str, dim: u32) {
        self.push(format!("{p}.weight"), &[dim], Role::NormGain);
        self.push(format!("{p}.bias"), &[dim], Role::NormOffset);
    }

    fn block(&mut self, p: &str, dim: u32, heads: u32, ratio: u32, qk_norm: bool, layer_scale: bool) {
        self.norm(&format!("{p}.norm1"), dim);
        self.linear(&format!("{p}.attn.qkv"), 3 * dim, dim);
        if qk_norm {
            self.norm(&format!("{p}.attn.q_norm"), dim / heads);
            self.norm(&format!("{p}.attn.k_norm"), dim / heads);
        }
        self.linear(&format!("{p}.attn.proj"), dim, dim);
        if layer_scale {
            self.push(format!("{p}.ls1.gamma"), &[dim], Role::LayerScale);
        }
        self.norm(&format!("{p}.norm2"), dim);
        self.linear(&format!("{p}.mlp.fc1"), ratio * dim, dim);
        self.linear(&format!("{p}.mlp.fc2"), dim, ratio * dim);
        if layer_scale {
            self.push(format!("{p}.ls2.gamma"), &[dim], Role::LayerScale);
        }
    }

    fn trunk(&mut self, p: &str, t: &Trunk, qk_norm: bool) {
        for i in 0..t.depth {
            self.block(&format!("{p}.{i}"), t.dim, t.heads, t.mlp_ratio, qk_norm, true);
        }
    }

    /// Pi3's decoder: `projects`, blocks without layer scale and q/k norms, `linear_out`.
    fn decoder(&mut self, p: &str, inp: u32, dim: u32, depth: u32, heads: u32, out: u32) {
        self.linear(&format!("{p}.projects"), dim, inp);
        for j in 0..depth {
            self.block(&format!("{p}.blocks.{j}"), dim, heads, 4, false, false);
        }
        self.linear(&format!("{p}.linear_out"), out, dim);
    }

    fn dpt(&mut self, p: &str, inp: u32, h: &Head) {
        self.norm(&format!("{p}.norm"), inp);
        let c = &h.channels;
        let f = h.features;
        for (i, &ch) in c.iter().enumerate() {
            self.conv(&format!("{p}.projects.{i}"), ch, inp, 1, true);
        }
        for (i, k) in [(0usize, 4u32), (1, 2)] {
            self.push(format!("{p}.resize_layers.{i}.weight"), &[c[i], c[i], k, k], Role::ConvTranspose);
            self.push(format!("{p}.resize_layers.{i}.bias"), &[c[i]], Role::Bias);
        }
        self.conv(&format!("{p}.resize_layers.3"), c[3], c[3], 3, true);
        let s = format!("{p}.scratch");
        for (i, &ch) in c.iter().enumerate() {
            self.conv(&format!("{s}.layer{}_rn", i + 1), f, ch, 3, false);
        }
        for i in 1..=4 {
            let r = format!("{s}.refinenet{i}");
            self.conv(&format!("{r}.out_conv"), f, f, 1, true);
            let units: &[&str] = if i == 4 { &["resConfUnit2"] } else { &["resConfUnit1", "resConfUnit2"] };
            for unit in units {
                self.conv(&format!("{r}.{unit}.conv1"), f, f, 3, true);
                self.conv(&format!("{r}.{unit}.conv2"), f, f, 3, true);
            }
        }
        self.conv(&format!("{s}.output_conv1"), f / 2, f, 3, true);
        self.conv(&format!("{s}.output_conv2.0"), h.hidden, f / 2, 3, true);
        self.conv(&format!("{s}.output_conv2.2"), h.out, h.hidden, 1, true);
    }

    fn guided(&mut self, name: &str, patch: u32, guide: u32, h: &Head) {
        let half = patch / 2;
        self.linear(&format!("{name}_head.proj"), half * half * h.hidden, h.dim);
        let f = h.features;
        let widths = [(f, h.hidden + guide), (f, f), (f, f), (4 * h.out, f)];
        for (i, (out, inp)) in widths.into_iter().enumerate() {
            self.conv(&format!("{name}_head.conv.{i}"), out, inp, 3, true);
        }
    }

    fn head(&mut self, name: &str, inp: u32, c: &ModelConfig, h: &Head) {
        match h.kind {
            HeadKind::XdecLinear => {
                self.decoder(&format!("{name}_decoder"), inp, h.dim, h.depth, h.heads, h.dim);
                self.linear(&format!("{name}_head.proj"), c.patch * c.patch * h.out, h.dim);
            }
            HeadKind::Guided => {
                self.decoder(&format!("{name}_decoder"), inp, h.dim, h.depth, h.heads, h.dim);
                self.guided(name, c.patch, c.guide_channels, h);
            }
            HeadKind::Dpt => self.dpt(&format!("{name}_head"), inp, h),
            HeadKind::None | HeadKind::XdecConv => {}
        }
    }
}

/// Every tensor of the network, in the order in which inference first reads them.
///
/// `config` must have passed [`ModelConfig::check`].
pub fn tensors(config: &ModelConfig) -> Vec<TensorSpec> {
    let mut l = List(Vec::new());
    let c = config;
    let (e, d) = (&c.encoder, c.encoder.dim);
    l.push("encoder.cls_token".into(), &[1, 1, d], Role::Table);
    l.push("encoder.pos_embed".into(), &[1, 1 + c.pos_grid * c.pos_grid, d], Role::Table);
    if e.registers > 0 {
        l.push("encoder.register_tokens".into(), &[1, e.registers, d], Role::Table);
    }
    l.conv("encoder.patch_embed.proj", d, 3, c.patch, true);
    l.trunk("encoder.blocks", e, false);
    l.norm("encoder.norm", d);

    if c.aa.registers > 0 {
        l.push("register_token".into(), &[1, 1, c.aa.registers, c.aa.dim], Role::Table);
    }
    if c.aa_time {
        l.linear("aa_time", c.aa.dim, c.time_dim);
    }
    l.trunk("decoder", &c.aa, true);

    let inp = c.head_in();
    // A DPT head always reads frame and global features of its pairs.
    let wide = |h: &Head| if h.kind == HeadKind::Dpt { 2 * c.aa.dim } else { inp };
    l.decoder("camera_decoder", inp, c.camera_dim, c.camera_depth, c.camera_heads, c.camera_width);
    let w = c.camera_width;
    for unit in 0..2 {
        for conv in 1..=3 {
            l.linear(&format!("camera_head.res_conv.{unit}.res_conv{conv}"), w, w);
        }
    }
    l.linear("camera_head.more_mlps.0", w, w);
    l.linear("camera_head.more_mlps.2", w, w);
    l.linear("camera_head.fc_t", 3, w);
    l.linear("camera_head.fc_rot", 9, w);
    if c.camera_k == KSource::Fov {
        l.linear("camera_head.fc_fov", 2, w);
    }

    if c.guide_channels > 0 {
        l.conv("image_stem", c.guide_channels, 3, 3, true);
    }
    l.head("point", wide(&c.depth), c, &c.depth);
    l.head("conf", wide(&c.conf), c, &c.conf);
    l.head("gs", wide(&c.gs), c, &c.gs);

    let dc = c.causal_dim();
    let sets: &[&str] = if c.causal_share { &["causal"] } else { &["causal", "causal_back"] };
    for set in sets {
        for i in 0..c.causal_depth {
            l.block(&format!("{set}.{i}"), dc, c.causal_heads, 4, true, true);
        }
    }
    l.head("motion", dc, c, &c.motion);
    l.0
}

/// Number of parameters of a network.
pub fn parameters(config: &ModelConfig) -> usize {
    tensors(config).iter().map(TensorSpec::len).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Head;

    fn count(config: &ModelConfig, prefixes: &[&str]) -> usize {
        tensors(config).iter().filter(|t| prefixes.iter().any(|p| t.name.starts_with(p))).map(TensorSpec::len).sum()
    }

    /// Self-check 1 of the network specification: published parameter counts.
    #[test]
    fn counts_are_the_published_ones() {
        let pi3 = ModelConfig::pi3();
        assert_eq!(parameters(&pi3), 958_696_732);
        assert_eq!(tensors(&pi3).len(), 1_208);
        assert_eq!(count(&pi3, &["encoder."]), 304_371_712);
        // Vanilla DINOv2 ViT-L/14-reg also stores a mask token of the encoder's width.
        assert_eq!(count(&pi3, &["encoder."]) + 1024, 304_372_736);
        assert_eq!(count(&pi3, &["decoder.", "register_token"]), 453_552_128);
        assert_eq!(count(&pi3, &["camera_head."]), 2_107_404);

        let linear = ModelConfig::full().with_linear_heads();
        assert_eq!(parameters(&linear), 1_156_821_784);
        assert_eq!(count(&linear, &["gs_"]), 68_338_796);
        assert_eq!(count(&linear, &["causal."]), 63_771_264);
        assert_eq!(count(&linear, &["motion_"]), 66_014_992);
        assert_eq!(parameters(&ModelConfig { conf: Head::none(), ..linear }), 1_090_491_988);

        let full = ModelConfig::full();
        assert_eq!(count(&full, &["gs_head."]), 32_654_859);
        assert_eq!(count(&full, &["motion_head."]), 30_129_700);
        assert_eq!(parameters(&full), 1_085_252_555);

        // VGGT's depth head: 2048 wide, two outputs.
        let vggt = ModelConfig { gs: Head { out: 2, ..ModelConfig::full().gs }, ..ModelConfig::full() };
        assert_eq!(count(&vggt, &["gs_head."]), 32_654_562);

        let base = ModelConfig::base().with_linear_heads();
        assert_eq!(parameters(&base), 113_829_016);
        assert_eq!(count(&base, &["camera_"]), 8_021_132);
        assert_eq!(parameters(&ModelConfig { conf: Head::none(), ..base }), 106_212_564);
    }

    /// The trained network, part by part; each count is also the PyTorch model's.
    #[test]
    fn nano_has_its_guided_heads() {
        let nano = ModelConfig::nano();
        let stem = 16 * 3 * 9 + 16;
        assert_eq!(count(&nano, &["image_stem"]), stem);
        // 24 channels for each of 7 x 7 half-resolution pixels, then the four convolutions.
        let head = |out: usize| {
            let linear = 128 * 1176 + 1176;
            linear + (40 * 9 + 1) * 32 + 2 * (32 * 9 + 1) * 32 + (32 * 9 + 1) * 4 * out
        };
        for (name, out) in [("point_head.", 2), ("gs_head.", 11), ("motion_head.", 4)] {
            assert_eq!(count(&nano, &[name]), head(out), "{name}");
        }
        assert_eq!(count(&nano, &["encoder."]), 903_296);
        assert_eq!(count(&nano, &["decoder."]), 1_192_704);
        assert_eq!(count(&nano, &["causal."]), 619_520);
        assert_eq!(parameters(&nano), 4_398_074);
        let linear = nano.with_linear_heads();
        linear.check("nano").unwrap();
        assert_eq!(count(&linear, &["image_stem"]), 0);
    }

    /// Self-check 2: layer scales and q/k norms stand exactly where they belong.
    #[test]
    fn gammas_and_qk_norms_are_where_they_belong() {
        for config in [ModelConfig::full(), ModelConfig::base().with_linear_heads(), ModelConfig::nano()] {
            for t in tensors(&config) {
                let trunk = ["encoder.blocks.", "decoder.", "causal."].iter().any(|p| t.name.starts_with(p));
                let qk = ["decoder.", "causal."].iter().any(|p| t.name.starts_with(p));
                assert!(!t.name.ends_with(".gamma") || trunk, "{}", t.name);
                assert!(!(t.name.contains("q_norm") || t.name.contains("k_norm")) || qk, "{}", t.name);
            }
            let gammas = tensors(&config).iter().filter(|t| t.name.ends_with(".gamma")).count();
            let qk = tensors(&config).iter().filter(|t| t.name.contains("_norm.")).count();
            let (e, a, c) = (config.encoder.depth, config.aa.depth, config.causal_depth);
            assert_eq!(gammas as u32, 2 * (e + a + c));
            assert_eq!(qk as u32, 4 * (a + c));
        }
    }

    #[test]
    fn names_are_unique() {
        let list = tensors(&ModelConfig { causal_share: false, ..ModelConfig::full() });
        let mut names: Vec<&str> = list.iter().map(|t| t.name.as_str()).collect();
        names.sort_unstable();
        let n = names.len();
        names.dedup();
        assert_eq!(n, names.len());
    }
}
