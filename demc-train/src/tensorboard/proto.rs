//! The messages of an event file: what a training needs of TensorFlow's `event.proto`, `summary.proto` and
//! `tensor.proto`, with their field numbers. The only importer of `prost`.
//!
//! Written out by hand instead of generated: thirty lines of fields against `protoc` in every build. A field that is
//! missing here is skipped by readers and by this decoder alike.

pub use prost::Message;

/// `Event`: what one record holds.
#[derive(Clone, PartialEq, Message)]
pub struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    pub wall_time: f64,
    /// Steps taken; for the start of a session the first step that it takes.
    #[prost(int64, tag = "2")]
    pub step: i64,
    /// The rest.
    #[prost(oneof = "What", tags = "3, 5, 7")]
    pub what: Option<What>,
}

/// `Event.what`
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum What {
    /// First event of every file.
    #[prost(string, tag = "3")]
    FileVersion(String),
    /// Values of a step.
    #[prost(message, tag = "5")]
    Summary(Summary),
    /// A session begins.
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

/// `SessionLog`
#[derive(Clone, PartialEq, Message)]
pub struct SessionLog {
    /// What happens to the session.
    #[prost(enumeration = "SessionStatus", tag = "1")]
    pub status: i32,
}

/// `SessionLog.SessionStatus`
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, prost::Enumeration)]
#[repr(i32)]
pub enum SessionStatus {
    /// Nothing; the format wants a zero.
    Unspecified = 0,
    /// It begins.
    Start = 1,
}

/// `Summary`
#[derive(Clone, PartialEq, Message)]
pub struct Summary {
    /// One a tag.
    #[prost(message, repeated, tag = "1")]
    pub value: Vec<Value>,
}

/// `Summary.Value`
#[derive(Clone, PartialEq, Message)]
pub struct Value {
    /// Name of the series; what stands before a slash groups series.
    #[prost(string, tag = "1")]
    pub tag: String,
    /// Which plugin shows a tensor; the other kinds need none.
    #[prost(message, optional, tag = "9")]
    pub metadata: Option<SummaryMetadata>,
    /// The value.
    #[prost(oneof = "Kind", tags = "2, 4, 8")]
    pub kind: Option<Kind>,
}

/// `Summary.Value.value`
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum Kind {
    /// A scalar.
    #[prost(float, tag = "2")]
    SimpleValue(f32),
    /// A picture.
    #[prost(message, tag = "4")]
    Image(Image),
    /// Text, as a tensor of one string.
    #[prost(message, tag = "8")]
    Tensor(Tensor),
}

/// `Summary.Image`
#[derive(Clone, PartialEq, Message)]
pub struct Image {
    /// Pixels.
    #[prost(int32, tag = "1")]
    pub height: i32,
    /// Pixels.
    #[prost(int32, tag = "2")]
    pub width: i32,
    /// Number of channels: [`RGB`].
    #[prost(int32, tag = "3")]
    pub colorspace: i32,
    /// The file.
    #[prost(bytes = "vec", tag = "4")]
    pub encoded_image_string: Vec<u8>,
}

/// [`Image::colorspace`] of three channels.
pub const RGB: i32 = 3;

/// `SummaryMetadata`
#[derive(Clone, PartialEq, Message)]
pub struct SummaryMetadata {
    /// Whose the series is.
    #[prost(message, optional, tag = "1")]
    pub plugin_data: Option<PluginData>,
}

/// `SummaryMetadata.PluginData`, without the content, which is empty for text.
#[derive(Clone, PartialEq, Message)]
pub struct PluginData {
    /// Name of the plugin.
    #[prost(string, tag = "1")]
    pub plugin_name: String,
}

/// `TensorProto` of strings.
#[derive(Clone, PartialEq, Message)]
pub struct Tensor {
    /// Type of the elements: [`DT_STRING`].
    #[prost(int32, tag = "1")]
    pub dtype: i32,
    /// Its shape.
    #[prost(message, optional, tag = "2")]
    pub tensor_shape: Option<TensorShape>,
    /// The elements.
    #[prost(bytes = "vec", repeated, tag = "8")]
    pub string_val: Vec<Vec<u8>>,
}

/// [`Tensor::dtype`] of strings.
pub const DT_STRING: i32 = 7;

/// `TensorShapeProto` without dimensions: a single element.
#[derive(Clone, PartialEq, Message)]
pub struct TensorShape {}
