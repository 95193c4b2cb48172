//! [`Model`]: a blob and the typed handles of every weight in it.
//!
//! Names and shapes are resolved here and nowhere else; afterwards a weight is a handle that cannot
//! miss. Handles hold positions, not borrows, so a `Model` is owned, `Send + Sync`, and shared by any
//! number of sessions.

use sf_formats::blob::{Blob, Dtype, LoadMode, Verify};
use sf_formats::config::{Head, HeadKind, KSource, ModelConfig, RcuSkip, Trunk};
use sf_formats::{Error, Result};
use sf_ops::gemm::s8::pack::QUAD;
use sf_ops::gemm::{PanelData, Panels, PanelsS8};
use sf_ops::hadamard::Rotation;
use sf_ops::simd::LANES;
use std::path::Path;
use std::sync::Arc;

/// A matrix in panels, `[n, k]`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PanelRef {
    /// Position in the blob.
    pub(crate) tensor: usize,
    dtype: Dtype,
    /// Outputs.
    pub(crate) n: usize,
    /// Inputs.
    pub(crate) k: usize,
}

impl PanelRef {
    /// Whether activations are quantized for it.
    pub(crate) fn is_int8(&self) -> bool {
        self.dtype == Dtype::Int8
    }
}

/// The panels behind a handle.
pub(crate) enum Weight<'a> {
    /// f32 or f16.
    Float(Panels<'a>),
    /// int8; inputs are rotated before they are quantized.
    Int8(PanelsS8<'a>, Option<Rotation<'a>>),
}

/// A vector or table in f32.
#[derive(Clone, Copy, Debug)]
pub(crate) struct VecRef(usize);

/// A matrix with its bias: linear layers and convolutions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Linear {
    pub(crate) weight: PanelRef,
    pub(crate) bias: Option<VecRef>,
}

/// A layer norm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Norm {
    pub(crate) gain: VecRef,
    pub(crate) offset: VecRef,
    pub(crate) eps: f32,
    /// Whether gain and offset do nothing: they are folded into what follows.
    pub(crate) plain: bool,
}

/// One transformer block.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    pub(crate) hidden: usize,
    pub(crate) norm1: Norm,
    pub(crate) qkv: Linear, // [3 dim, dim]
    /// Per-head query and key norms, `dim / heads` wide.
    pub(crate) qk: Option<(Norm, Norm)>,
    pub(crate) proj: Linear, // [dim, dim]
    pub(crate) ls1: Option<VecRef>,
    pub(crate) norm2: Norm,
    pub(crate) fc1: Linear, // [hidden, dim]
    pub(crate) fc2: Linear, // [dim, hidden]
    pub(crate) ls2: Option<VecRef>,
}

impl Block {
    /// Whether attention runs in int8: the layers around it do.
    pub(crate) fn int8_attention(&self) -> bool {
        self.qkv.weight.is_int8() && self.proj.weight.is_int8()
    }
}

/// Pi3's decoder: projection, blocks, projection.
#[derive(Clone, Debug)]
pub(crate) struct Decoder {
    pub(crate) projects: Linear,
    pub(crate) blocks: Vec<Block>,
    pub(crate) linear_out: Linear,
}

/// A residual unit of a DPT pyramid: two 3x3 convolutions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Unit {
    pub(crate) conv1: Linear,
    pub(crate) conv2: Linear,
}

/// One fusion level of a DPT pyramid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fusion {
    /// On the level's own features; the coarsest level has none.
    pub(crate) lateral: Option<Unit>,
    pub(crate) unit: Unit,
    pub(crate) out: Linear,
}

/// VGGT's convolutional head over four taps.
#[derive(Clone, Debug)]
pub(crate) struct Dpt {
    pub(crate) taps: [usize; 4],
    pub(crate) channels: [usize; 4],
    pub(crate) features: usize,
    pub(crate) hidden: usize,
    pub(crate) out: usize,
    pub(crate) skip: RcuSkip,
    pub(crate) norm: Norm,
    pub(crate) projects: [Linear; 4],
    pub(crate) up4: Linear,
    pub(crate) up2: Linear,
    pub(crate) down2: Linear,
    pub(crate) lateral: [Linear; 4],
    /// Finest first, as the tensors are named: `refinenet1` to `refinenet4`.
    pub(crate) fusion: [Fusion; 4],
    pub(crate) output1: Linear,
    pub(crate) output2: Linear,
    pub(crate) last: Linear,
}

/// Transformer decoder, linear layer, pixel shuffle.
#[derive(Clone, Debug)]
pub(crate) struct LinearHead {
    pub(crate) decoder: Decoder,
    pub(crate) proj: Linear, // [out patch^2, dim]
    pub(crate) out: usize,
}

/// Transformer decoder, linear layer to half resolution, convolutions beside the image stem.
#[derive(Clone, Debug)]
pub(crate) struct Guided {
    pub(crate) decoder: Decoder,
    pub(crate) proj: Linear, // [hidden (patch/2)^2, dim]
    pub(crate) convs: [Linear; 4],
    pub(crate) hidden: usize,
    pub(crate) guide: usize,
    pub(crate) features: usize,
    pub(crate) out: usize,
}

/// A dense head.
#[derive(Clone, Debug)]
pub(crate) enum DenseHead {
    Linear(LinearHead),
    Guided(Box<Guided>),
    Dpt(Box<Dpt>),
}

impl DenseHead {
    /// The decoder of a head that has one.
    pub(crate) fn decoder(&self) -> Option<&Decoder> {
        match self {
            DenseHead::Linear(h) => Some(&h.decoder),
            DenseHead::Guided(h) => Some(&h.decoder),
            DenseHead::Dpt(_) => None,
        }
    }
}

/// The camera decoder and head.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    pub(crate) decoder: Decoder,
    pub(crate) units: [[Linear; 3]; 2],
    pub(crate) mlps: [Linear; 2],
    pub(crate) t: Linear,
    pub(crate) rot: Linear,
    pub(crate) fov: Option<Linear>,
}

/// Every weight of the network.
#[derive(Clone, Debug)]
pub(crate) struct Weights {
    pub(crate) patch: Linear,             // [dim, patch^2 3], k = [ky][kx][rgb]
    pub(crate) cls: VecRef,               // [dim]
    pub(crate) positions: VecRef,         // [1 + grid^2, dim]
    pub(crate) registers: Option<VecRef>, // [encoder registers, dim]
    pub(crate) encoder: Vec<Block>,
    pub(crate) encoder_norm: Norm,
    pub(crate) aa_registers: Option<VecRef>, // [aa registers, dim]
    pub(crate) aa_time: Option<Linear>,      // [dim, d_t]
    pub(crate) aa: Vec<Block>,
    pub(crate) camera: Camera,
    /// The image stem of guided heads: a 3x3 convolution, `[guide.channels, 27]`.
    pub(crate) stem: Option<Linear>,
    pub(crate) depth: DenseHead,
    pub(crate) conf: Option<DenseHead>,
    pub(crate) gs: Option<DenseHead>,
    pub(crate) causal: Vec<Block>,
    /// The backward pass's own set, where the passes do not share.
    pub(crate) causal_back: Option<Vec<Block>>,
    pub(crate) motion: Option<DenseHead>,
}

/// A network ready to run: weights and configuration, immutable.
///
/// ```no_run
/// # fn main() -> sf_formats::Result<()> {
/// use sf_formats::blob::LoadMode;
/// let model = streetforward::Model::open("nano.sfw".as_ref(), LoadMode::Map)?;
/// println!("{} parameters", model.parameters());
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Model {
    blob: Arc<Blob>,
    /// The blob's own, or one with other conventions.
    config: ModelConfig,
    weights: Weights,
}

impl Model {
    /// Opens a `.sfw` file, every tensor's digest verified.
    pub fn open(path: &Path, mode: LoadMode) -> Result<Model> {
        Self::from_blob(Blob::open(path, mode, Verify::Digests)?)
    }

    /// From an opened blob.
    pub fn from_blob(blob: Blob) -> Result<Model> {
        let config = blob.config().clone();
        Self::new(Arc::new(blob), config)
    }

    /// The same weights under other conventions (`mask.k`, `render.window`, ...): for ablations and experiments.
    ///
    /// # Errors
    /// `Model` when the configuration is not valid or asks for other tensors.
    pub fn with_config(&self, config: ModelConfig) -> Result<Model> {
        if sf_formats::arch::tensors(&config) != sf_formats::arch::tensors(&self.config) {
            return Err(Error::model("configuration", "asks for other tensors than the model has"));
        }
        Self::new(Arc::clone(&self.blob), config)
    }

    fn new(blob: Arc<Blob>, config: ModelConfig) -> Result<Model> {
        config.check("model")?;
        let weights = Lookup { blob: &blob, config: &config }.weights()?;
        Ok(Model { blob, config, weights })
    }

    /// Sizes and conventions.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// The file behind it.
    pub fn blob(&self) -> &Blob {
        &self.blob
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        sf_formats::arch::parameters(self.config())
    }

    pub(crate) fn weights(&self) -> &Weights {
        &self.weights
    }

    /// The names of all tensors, in the order of their positions.
    pub(crate) fn names(&self) -> Vec<String> {
        let mut names = vec![String::new(); self.blob.tensors().len()];
        for spec in sf_formats::arch::tensors(&self.config) {
            if let Some(i) = self.blob.find(&spec.name) {
                names[i] = spec.name;
            }
        }
        names
    }

    /// The panels behind a handle.
    pub(crate) fn weight(&self, r: &PanelRef) -> Weight<'_> {
        let data = match r.dtype {
            Dtype::F32 => PanelData::F32(self.blob.f32s(r.tensor)),
            Dtype::F16 => PanelData::F16(self.blob.f16s(r.tensor)),
            Dtype::Int8 => {
                let m = self.blob.int8(r.tensor);
                let rotation = (!m.signs.is_empty()).then(|| Rotation::new(r.k, m.signs));
                let panels = PanelsS8 { n: r.n, k: r.k, data: m.data, scales: m.scales, col_sums: m.sums };
                return Weight::Int8(panels, rotation);
            }
        };
        Weight::Float(Panels { n: r.n, k: r.k, data })
    }

    /// The rotation of heads of width `d` in front of int8 scores: the first signs of the output projection, for any
    /// random ones will do. None where the width has none.
    pub(crate) fn head_rotation(&self, proj: &PanelRef, d: usize) -> Option<Rotation<'_>> {
        let signs = self.blob.int8(proj.tensor).signs;
        (d.is_multiple_of(LANES) && signs.len() >= d / LANES).then(|| Rotation::new(d, &signs[..d / LANES]))
    }

    /// The panels behind the handle of a convolution that reads the image, which is never int8.
    pub(crate) fn panels(&self, r: &PanelRef) -> Panels<'_> {
        match self.weight(r) {
            Weight::Float(panels) => panels,
            Weight::Int8(..) => unreachable!("refused when the model was made"),
        }
    }

    /// The values behind a handle.
    pub(crate) fn values(&self, r: VecRef) -> &[f32] {
        self.blob.f32s(r.0)
    }
}

struct Lookup<'a> {
    blob: &'a Blob,
    config: &'a ModelConfig,
}

impl Lookup<'_> {
    fn find(&self, name: &str) -> Result<usize> {
        self.blob.find(name).ok_or_else(|| Error::model(name, "tensor is missing: convert the checkpoint again"))
    }

    fn panels(&self, name: &str, n: usize, k: usize) -> Result<PanelRef> {
        let tensor = self.find(name)?;
        let record = &self.blob.tensors()[tensor];
        let (have, need) = match record.dtype {
            Dtype::F32 => (self.blob.f32s(tensor).len(), sf_ops::gemm::panel_len(n, k)),
            Dtype::F16 => (self.blob.f16s(tensor).len(), sf_ops::gemm::panel_len(n, k)),
            Dtype::Int8 => (self.blob.int8(tensor).data.len(), sf_ops::gemm::panel_len_s8(n, k)),
        };
        if have != need {
            return Err(Error::model(name, format!("{have} values in panels, {n} x {k} needs {need}")));
        }
        Ok(PanelRef { tensor, dtype: record.dtype, n, k })
    }

    /// Panels of a convolution: int8 ones are not rotated, and have whole quads of channels, as those that read the
    /// image have not.
    fn conv_panels(&self, name: &str, n: usize, (area, inputs): (usize, usize)) -> Result<PanelRef> {
        let panels = self.panels(name, n, area * inputs)?;
        if panels.is_int8() && (!self.blob.int8(panels.tensor).signs.is_empty() || !inputs.is_multiple_of(QUAD)) {
            let why = format!("an int8 convolution over {inputs} channels, not in fours or rotated: convert it again");
            return Err(Error::unsupported(name, why));
        }
        Ok(panels)
    }

    fn values(&self, name: &str, len: usize) -> Result<VecRef> {
        let tensor = self.find(name)?;
        let record = &self.blob.tensors()[tensor];
        if record.dtype != Dtype::F32 || self.blob.f32s(tensor).len() != len {
            return Err(Error::model(name, format!("must be {len} values of f32")));
        }
        Ok(VecRef(tensor))
    }

    fn linear(&self, name: &str, n: usize, k: usize) -> Result<Linear> {
        let weight = self.panels(&format!("{name}.weight"), n, k)?;
        Ok(Linear { weight, bias: Some(self.values(&format!("{name}.bias"), n)?) })
    }

    fn conv(&self, name: &str, out: usize, inputs: usize, kernel: usize) -> Result<Linear> {
        let weight = self.conv_panels(&format!("{name}.weight"), out, (kernel * kernel, inputs))?;
        Ok(Linear { weight, bias: Some(self.values(&format!("{name}.bias"), out)?) })
    }

    fn norm(&self, name: &str, dim: usize, eps: f64) -> Result<Norm> {
        let gain = self.values(&format!("{name}.weight"), dim)?;
        let offset = self.values(&format!("{name}.bias"), dim)?;
        let plain = self.all(gain, 1.0) && self.all(offset, 0.0);
        Ok(Norm { gain, offset, eps: eps as f32, plain })
    }

    /// Whether every value of a vector is `value`.
    fn all(&self, r: VecRef, value: f32) -> bool {
        self.blob.f32s(r.0).iter().all(|&v| v == value)
    }

    fn block(&self, p: &str, t: &Trunk, kind: BlockKind) -> Result<Block> {
        let (dim, heads) = (t.dim as usize, t.heads as usize);
        let hidden = dim * t.mlp_ratio as usize;
        let norm = |name: &str| self.norm(&format!("{p}.{name}"), dim, t.eps);
        let scale = |name: &str| match kind {
            BlockKind::Decoder => Ok(None),
            // Ones do nothing: they are folded into the matrix in front.
            _ => self.values(&format!("{p}.{name}.gamma"), dim).map(|g| (!self.all(g, 1.0)).then_some(g)),
        };
        let qk = match kind {
            BlockKind::Aa => {
                let part = |name: &str| self.norm(&format!("{p}.attn.{name}"), dim / heads, self.config.qk_eps);
                Some((part("q_norm")?, part("k_norm")?))
            }
            _ => None,
        };
        Ok(Block {
            dim,
            heads,
            hidden,
            norm1: norm("norm1")?,
            qkv: self.linear(&format!("{p}.attn.qkv"), 3 * dim, dim)?,
            qk,
            proj: self.linear(&format!("{p}.attn.proj"), dim, dim)?,
            ls1: scale("ls1")?,
            norm2: norm("norm2")?,
            fc1: self.linear(&format!("{p}.mlp.fc1"), hidden, dim)?,
            fc2: self.linear(&format!("{p}.mlp.fc2"), dim, hidden)?,
            ls2: scale("ls2")?,
        })
    }

    fn trunk(&self, p: &str, t: &Trunk, kind: BlockKind) -> Result<Vec<Block>> {
        (0..t.depth).map(|i| self.block(&format!("{p}.{i}"), t, kind)).collect()
    }

    fn decoder(&self, p: &str, inputs: usize, t: &Trunk, out: usize) -> Result<Decoder> {
        Ok(Decoder {
            projects: self.linear(&format!("{p}.projects"), t.dim as usize, inputs)?,
            blocks: self.trunk(&format!("{p}.blocks"), t, BlockKind::Decoder)?,
            linear_out: self.linear(&format!("{p}.linear_out"), out, t.dim as usize)?,
        })
    }

    fn dpt(&self, p: &str, inputs: usize, h: &Head) -> Result<Dpt> {
        let list = |l: &[u32]| -> [usize; 4] { std::array::from_fn(|i| l[i] as usize) };
        let (channels, f) = (list(&h.channels), h.features as usize);
        let s = format!("{p}.scratch");
        let unit = |name: String| -> Result<Unit> {
            let conv1 = self.conv(&format!("{name}.conv1"), f, f, 3)?;
            Ok(Unit { conv1, conv2: self.conv(&format!("{name}.conv2"), f, f, 3)? })
        };
        let fusion = |i: usize| -> Result<Fusion> {
            let r = format!("{s}.refinenet{i}");
            Ok(Fusion {
                lateral: if i == 4 { None } else { Some(unit(format!("{r}.resConfUnit1"))?) },
                unit: unit(format!("{r}.resConfUnit2"))?,
                out: self.conv(&format!("{r}.out_conv"), f, f, 1)?,
            })
        };
        // 1x1 convolutions that run as linear layers.
        let project = |i: usize| self.linear(&format!("{p}.projects.{i}"), channels[i], inputs);
        let lateral = |i: usize| -> Result<Linear> {
            let weight = self.conv_panels(&format!("{s}.layer{}_rn.weight", i + 1), f, (9, channels[i]))?;
            Ok(Linear { weight, bias: None })
        };
        let up = |i: usize, k: usize| -> Result<Linear> {
            let c = channels[i];
            let weight = self.conv_panels(&format!("{p}.resize_layers.{i}.weight"), k * k * c, (1, c))?;
            Ok(Linear { weight, bias: Some(self.values(&format!("{p}.resize_layers.{i}.bias"), c)?) })
        };
        let (hidden, out) = (h.hidden as usize, h.out as usize);
        Ok(Dpt {
            taps: list(&h.taps),
            channels,
            features: f,
            hidden,
            out,
            skip: h.rcu_skip,
            norm: self.norm(&format!("{p}.norm"), inputs, h.eps)?,
            projects: [project(0)?, project(1)?, project(2)?, project(3)?],
            up4: up(0, 4)?,
            up2: up(1, 2)?,
            down2: self.conv(&format!("{p}.resize_layers.3"), channels[3], channels[3], 3)?,
            lateral: [lateral(0)?, lateral(1)?, lateral(2)?, lateral(3)?],
            fusion: [fusion(1)?, fusion(2)?, fusion(3)?, fusion(4)?],
            output1: self.conv(&format!("{s}.output_conv1"), f / 2, f, 3)?,
            output2: self.conv(&format!("{s}.output_conv2.0"), hidden, f / 2, 3)?,
            last: self.conv(&format!("{s}.output_conv2.2"), out, hidden, 1)?,
        })
    }

    fn guided(&self, name: &str, inputs: usize, h: &Head) -> Result<Guided> {
        let (hidden, features, out) = (h.hidden as usize, h.features as usize, h.out as usize);
        let (dim, guide, half) = (h.dim as usize, self.config.guide_channels as usize, self.config.patch as usize / 2);
        let conv = |i: usize, out: usize, inputs: usize| self.conv(&format!("{name}_head.conv.{i}"), out, inputs, 3);
        let t = decoder_trunk(h.dim, h.depth, h.heads, h.eps);
        Ok(Guided {
            decoder: self.decoder(&format!("{name}_decoder"), inputs, &t, dim)?,
            proj: self.linear(&format!("{name}_head.proj"), half * half * hidden, dim)?,
            convs: [
                conv(0, features, hidden + guide)?,
                conv(1, features, features)?,
                conv(2, features, features)?,
                conv(3, 4 * out, features)?,
            ],
            hidden,
            guide,
            features,
            out,
        })
    }

    /// `inputs` are the features of a head with a decoder, `taps` those of a DPT head.
    fn head(&self, name: &str, inputs: usize, taps: usize, h: &Head) -> Result<Option<DenseHead>> {
        Ok(match h.kind {
            HeadKind::None | HeadKind::XdecConv => None,
            HeadKind::XdecLinear => {
                let t = decoder_trunk(h.dim, h.depth, h.heads, h.eps);
                let area = (self.config.patch * self.config.patch) as usize;
                Some(DenseHead::Linear(LinearHead {
                    decoder: self.decoder(&format!("{name}_decoder"), inputs, &t, h.dim as usize)?,
                    proj: self.linear(&format!("{name}_head.proj"), area * h.out as usize, h.dim as usize)?,
                    out: h.out as usize,
                }))
            }
            HeadKind::Guided => Some(DenseHead::Guided(Box::new(self.guided(name, inputs, h)?))),
            HeadKind::Dpt => Some(DenseHead::Dpt(Box::new(self.dpt(&format!("{name}_head"), taps, h)?))),
        })
    }

    fn camera(&self) -> Result<Camera> {
        let c = self.config;
        let t = decoder_trunk(c.camera_dim, c.camera_depth, c.camera_heads, c.aa.eps);
        let w = c.camera_width as usize;
        let unit = |u: usize, i: usize| self.linear(&format!("camera_head.res_conv.{u}.res_conv{i}"), w, w);
        Ok(Camera {
            decoder: self.decoder("camera_decoder", c.head_in() as usize, &t, w)?,
            units: [[unit(0, 1)?, unit(0, 2)?, unit(0, 3)?], [unit(1, 1)?, unit(1, 2)?, unit(1, 3)?]],
            mlps: [self.linear("camera_head.more_mlps.0", w, w)?, self.linear("camera_head.more_mlps.2", w, w)?],
            t: self.linear("camera_head.fc_t", 3, w)?,
            rot: self.linear("camera_head.fc_rot", 9, w)?,
            fov: if c.camera_k == KSource::Fov { Some(self.linear("camera_head.fc_fov", 2, w)?) } else { None },
        })
    }

    fn weights(&self) -> Result<Weights> {
        let c = self.config;
        let (dim, patch, grid) = (c.encoder.dim as usize, c.patch as usize, c.pos_grid as usize);
        let tokens = |name: &str, count: u32| match count {
            0 => Ok(None),
            n => self.values(name, n as usize * dim).map(Some),
        };
        let (inputs, pair) = (c.head_in() as usize, 2 * c.aa.dim as usize);
        let causal_trunk = Trunk {
            dim: c.causal_dim(),
            depth: c.causal_depth,
            heads: c.causal_heads,
            registers: 0,
            mlp_ratio: 4,
            eps: c.aa.eps,
        };
        let causal_dim = c.causal_dim() as usize;
        let need = |head: Option<DenseHead>| head.ok_or_else(|| Error::model("depth", "the depth head is missing"));
        Ok(Weights {
            patch: self.conv("encoder.patch_embed.proj", dim, 3, patch)?,
            cls: self.values("encoder.cls_token", dim)?,
            positions: self.values("encoder.pos_embed", (1 + grid * grid) * dim)?,
            registers: tokens("encoder.register_tokens", c.encoder.registers)?,
            encoder: self.trunk("encoder.blocks", &c.encoder, BlockKind::Encoder)?,
            encoder_norm: self.norm("encoder.norm", dim, c.encoder.eps)?,
            aa_registers: tokens("register_token", c.aa.registers)?,
            aa_time: if c.aa_time { Some(self.linear("aa_time", dim, c.time_dim as usize)?) } else { None },
            aa: self.trunk("decoder", &c.aa, BlockKind::Aa)?,
            camera: self.camera()?,
            stem: match c.guide_channels {
                0 => None,
                n => Some(self.conv("image_stem", n as usize, 3, 3)?),
            },
            depth: need(self.head("point", inputs, pair, &c.depth)?)?,
            conf: self.head("conf", inputs, pair, &c.conf)?,
            gs: self.head("gs", inputs, pair, &c.gs)?,
            causal: self.trunk("causal", &causal_trunk, BlockKind::Aa)?,
            causal_back: if c.causal_share || c.causal_depth == 0 {
                None
            } else {
                Some(self.trunk("causal_back", &causal_trunk, BlockKind::Aa)?)
            },
            motion: self.head("motion", causal_dim, causal_dim, &c.motion)?,
        })
    }
}

/// Which optional parts a block has (network specification 4.1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum BlockKind {
    /// Layer scale, no query and key norms.
    Encoder,
    /// Layer scale, query and key norms.
    Aa,
    /// Neither.
    Decoder,
}

/// A head's decoder as a trunk; its MLPs are four times as wide as the tokens.
fn decoder_trunk(dim: u32, depth: u32, heads: u32, eps: f64) -> Trunk {
    Trunk { dim, depth, heads, registers: 0, mlp_ratio: 4, eps }
}
