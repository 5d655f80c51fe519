"""Learning the bias of TDOAs from flights with ground truth.

labels     flights -> what each TDOA was wrong by, at which pose; which flights train and which validate
models     the kinds of models, all trained by one call
paper      the network of Zhao et al. (RA-L 2021)
structured the error of a pair as the difference of two one-anchor errors
physics    the effects that diagnose can name
shrinking  the share of a model that cross-validation over flights supports
linear     robust Bayesian regression on sparse designs: what structured is fitted with
export     ONNX files with metadata
plots      the learning curve
"""
