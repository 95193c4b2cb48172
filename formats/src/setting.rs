//! Typed configuration values and the named alternatives of every convention.
//!
//! A [`Setting`] is anything that can stand as one value of [`crate::ModelConfig`]; the alternatives of a
//! convention are enums whose text names are the ones written to files.

/// One configuration value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Integers and sizes.
    Int(i64),
    /// Real numbers.
    Float(f64),
    /// Switches.
    Bool(bool),
    /// Names of alternatives.
    Text(String),
    /// Lists of integers.
    Ints(Vec<i64>),
    /// Lists of reals.
    Floats(Vec<f64>),
}

/// A type that can stand as one configuration value.
pub trait Setting: Sized {
    /// As a value.
    fn to_value(&self) -> Value;
    /// From a value of the right type and range.
    fn from_value(v: &Value) -> Option<Self>;
}

impl Setting for u32 {
    fn to_value(&self) -> Value {
        Value::Int(i64::from(*self))
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Int(i) => u32::try_from(*i).ok(),
            _ => None,
        }
    }
}

impl Setting for i32 {
    fn to_value(&self) -> Value {
        Value::Int(i64::from(*self))
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Int(i) => i32::try_from(*i).ok(),
            _ => None,
        }
    }
}

impl Setting for f64 {
    fn to_value(&self) -> Value {
        Value::Float(*self)
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Float(f) if f.is_finite() => Some(*f),
            Value::Int(i) => Some(*i as f64),
            _ => None,
        }
    }
}

impl Setting for bool {
    fn to_value(&self) -> Value {
        Value::Bool(*self)
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Bool(b) => Some(*b),
            _ => None,
        }
    }
}

impl Setting for Vec<u32> {
    fn to_value(&self) -> Value {
        Value::Ints(self.iter().map(|&i| i64::from(i)).collect())
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Ints(l) => l.iter().map(|&i| u32::try_from(i).ok()).collect(),
            // An empty list carries no element type in JSON.
            Value::Floats(l) if l.is_empty() => Some(Vec::new()),
            _ => None,
        }
    }
}

impl Setting for Option<[u32; 2]> {
    fn to_value(&self) -> Value {
        Value::Ints(self.iter().flatten().map(|&i| i64::from(i)).collect())
    }
    fn from_value(v: &Value) -> Option<Self> {
        match <Vec<u32>>::from_value(v)?[..] {
            [] => Some(None),
            [a, b] => Some(Some([a, b])),
            _ => None,
        }
    }
}

impl Setting for [f64; 3] {
    fn to_value(&self) -> Value {
        Value::Floats(self.to_vec())
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Floats(l) if l.iter().all(|f| f.is_finite()) => <[f64; 3]>::try_from(&l[..]).ok(),
            Value::Ints(l) => <[i64; 3]>::try_from(&l[..]).ok().map(|a| a.map(|i| i as f64)),
            _ => None,
        }
    }
}

macro_rules! choice {
    ($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident = $text:literal),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name { $($(#[$vdoc])* $variant),* }
        impl Setting for $name {
            fn to_value(&self) -> Value {
                Value::Text(match self { $($name::$variant => $text),* }.to_string())
            }
            fn from_value(v: &Value) -> Option<Self> {
                match v {
                    Value::Text(t) => match t.as_str() { $($text => Some($name::$variant),)* _ => None },
                    _ => None,
                }
            }
        }
    };
}

choice! {
    /// How frames are resized to the network's size (Pillow-compatible window filters, 8-bit).
    Resample {
        /// Cubic convolution, a = -0.5, window widened when shrinking.
        Bicubic = "bicubic",
        /// Lanczos with three lobes, as Pi3's public loader.
        Lanczos = "lanczos",
        /// Triangle filter.
        Bilinear = "bilinear",
    }
}
choice! {
    /// Which alternating-attention layers come first.
    Order {
        /// Even layers inside a frame, odd layers over all frames (Pi3).
        FrameFirst = "frame_first",
        /// The other way round.
        GlobalFirst = "global_first",
    }
}
choice! {
    /// Rounding of the rotary angles before sine and cosine.
    AngleRound {
        /// Full precision.
        None = "none",
        /// To bfloat16, as the released half-precision pipelines do.
        Bf16 = "bf16",
    }
}
choice! {
    /// Which alternating-attention features a consumer reads.
    Concat {
        /// Last frame layer then last global layer, 2 x width.
        FrameGlobal = "frame_global",
        /// Last layer of the pair only, 1 x width.
        Last = "last",
    }
}
choice! {
    /// Kind of a dense head.
    HeadKind {
        /// The head does not exist.
        None = "none",
        /// Transformer decoder, one linear layer, pixel shuffle (Pi3).
        XdecLinear = "xdec_linear",
        /// Transformer decoder with convolutional output (Pi3X); known, not executed.
        XdecConv = "xdec_conv",
        /// Four-tap convolutional pyramid (VGGT's DPT head).
        Dpt = "dpt",
        /// Transformer decoder, then 3x3 convolutions at half resolution that also see the image.
        Guided = "guided",
    }
}
choice! {
    /// What the skip path of a DPT residual unit adds.
    RcuSkip {
        /// `relu(x)`: what VGGT's in-place activation executes.
        Relu = "relu",
        /// `x`: the textbook unit (Depth-Anything-3).
        Raw = "raw",
    }
}
choice! {
    /// From raw depth-head channels to depth.
    DepthMap {
        /// Channels (a, b, l): z = exp(l), local point (a z, b z, z) (Pi3).
        Pi3Point = "pi3_point",
        /// One channel l: z = exp(l), rays from K.
        ExpZ = "exp_z",
        /// Channels (l, c): z = exp(l), rays from K; c is the confidence logit.
        ExpZConf = "exp_z_conf",
    }
}
choice! {
    /// From raw Gaussian-head channels to parameters.
    GsMap {
        /// Residuals on priors: colour = image + d, opacity = sigmoid(o + 2),
        /// scale = 0.7 (z / f) exp(clamp(d, -4, 4)), quaternion + identity in camera axes.
        Residual = "residual",
        /// DGGT: colour sigmoid, opacity sigmoid, scale 0.1 softplus, quaternion in world axes.
        Dggt = "dggt",
    }
}
choice! {
    /// Where the intrinsics come from.
    KSource {
        /// Least squares on the predicted rays, shared over the clip, centred principal point.
        FitShared = "fit_shared",
        /// The same, each frame for itself.
        FitFrame = "fit_frame",
        /// Two field-of-view channels of the camera head (`camera_head.fc_fov`): log(fx/W), log(fy/H).
        Fov = "fov",
    }
}
choice! {
    /// Where a pixel's ray passes.
    PixelCentre {
        /// (u + 0.5, v + 0.5) with the principal point at W/2, H/2.
        Half = "half",
        /// (u, v) against W/2, H/2, VGGT's convention with its half-pixel offset.
        Integer = "integer",
    }
}
choice! {
    /// Reading of the causal mask.
    Orientation {
        /// Forward pass: frame f sees f..f+k (the paper's equation).
        Equation = "equation",
        /// Forward pass: frame f sees f-k..f (the figure read row = query).
        Figure = "figure",
    }
}
choice! {
    /// Output channels of the motion head.
    MotionLayout {
        /// One pass gives one direction: velocity 3, dynamic logit 1.
        PerDirection = "per_direction",
        /// One pass gives both: v+ 3, v- 3, dynamic logit 1.
        SinglePass = "single_pass",
    }
}
choice! {
    /// Axes of the predicted velocity.
    MotionFrame {
        /// The source camera's axes; rotated to world.
        Camera = "camera",
        /// World axes.
        World = "world",
    }
}
choice! {
    /// Unit of time of the predicted velocity.
    MotionPer {
        /// Scene units per second.
        Second = "second",
        /// Scene units per step between sampled frames.
        Step = "step",
    }
}
choice! {
    /// How the two passes' dynamic probabilities become one.
    Combine {
        /// Mean over the directions that have a neighbour.
        Mean = "mean",
        /// Maximum over those directions.
        Max = "max",
    }
}
choice! {
    /// World gauge.
    Anchor {
        /// The first frame's camera is the world.
        First = "first",
        /// The network's own gauge.
        Raw = "raw",
    }
}
choice! {
    /// What happens to a frame's own dynamic Gaussians when rendering exactly at its time.
    SelfRule {
        /// Only the frame's own dynamic set (inference default).
        Own = "own",
        /// Only its neighbours' (the paper's training rule).
        Neighbours = "neighbours",
    }
}
choice! {
    /// Velocity used before the first and after the last frame.
    Extrapolate {
        /// The trained direction of that frame, mirrored: -v- after the end, -v+ before the start.
        Mirror = "mirror",
        /// The untrained direction itself.
        Direct = "direct",
    }
}
choice! {
    /// Static/dynamic separation.
    Split {
        /// Dynamic iff the probability exceeds tau (the paper's indicator).
        Hard = "hard",
        /// Every Gaussian twice, opacity weighted by probability (DGGT).
        Soft = "soft",
    }
}
choice! {
    /// Treatment of the sky.
    Sky {
        /// Ordinary static Gaussians.
        None = "none",
        /// Pixels with confidence under `sky.conf` are pushed to a far shell.
        FarShell = "far_shell",
    }
}
choice! {
    /// An extra image shortcut before a DPT head's last layer.
    ImageMerger {
        /// None.
        None = "none",
    }
}
