import os
LN=float(os.environ.get("SLICE","2"))
import ctypes, time, sys, numpy as np
sys.path[:0]=["worker"]
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics.model import BranchModel
import limber.mechanics.linear.equations as eq, limber.mechanics.model as mo
from limber.mechanics.elements import forces
lib=ctypes.CDLL("./elements.so"); lib.force_10_4.restype=ctypes.c_double
P=lambda a: ctypes.c_void_p(a.ctypes.data)
def aligned(a):
    a=np.ascontiguousarray(a); raw=np.empty(a.nbytes+128,np.uint8); o=-raw.ctypes.data%128
    out=raw[o:o+a.nbytes].view(a.dtype).reshape(a.shape); out[...]=a; return out
captured={}
import limber.mechanics.elements.stiffness as st
for size in map(float,sys.argv[1:]):
    mesh=straight_beam(size,0.01,slice_count=int(LN),sides=int(os.environ.get("SIDES","6")))
    mesh = mesh[0] if isinstance(mesh,tuple) else mesh
    if mesh.tets.shape[1]==4: mesh=mesh.quadratic()
    model=BranchModel(mesh, young=1e9, poisson=0.35, density=900.0)
    rng=np.random.default_rng(1); u=1e-3*rng.normal(size=mesh.nodes.shape)
    keepT=eq.tangent_stiffness; keepF=forces.internal_force
    def capT(*a): captured["T"]=a; return keepT(*a)
    def capF(*a): captured["F"]=a; return keepF(*a)
    eq.tangent_stiffness=capT; forces.internal_force=capF
    model.internal(u)
    model.equations().assemble(model,u)
    eq.tangent_stiffness=keepT; forces.internal_force=keepF
    a=captured["T"]; disp,incr,g,w,lam,mu,nodes,material,growth,memory,slots,lengths,values=a
    print(mesh.tets.shape, material, growth, nodes.dtype, slots.dtype, incr.shape, memory.shape)
    G,W,L,M=map(aligned,(g,w,lam,mu)); N=aligned(nodes.astype(np.int64)); S,LE=aligned(slots.astype(np.int32)),aligned(lengths.astype(np.int32)); U=aligned(disp)
    v1=np.zeros_like(values); v2=np.zeros_like(values)
    def numba(): v1[:]=0; keepT(disp,incr,g,w,lam,mu,nodes,material,growth,memory,slots,lengths,v1)
    def native(): v2[:]=0; lib.tangent_10_4(P(U),ctypes.c_int64(len(N)),P(G),P(W),P(L),P(M),P(N),P(S),P(LE),P(v2))
    numba(); native()
    print("tangent diff", np.abs(v1-v2).max()/np.abs(v1).max())
    f=captured["F"]; fd=list(f)
    out1,en1=np.zeros_like(f[-2]),np.zeros_like(f[-1]); out2,en2=aligned(out1),aligned(en1)
    def numbaF(): return keepF(*f[:-2],out1,en1)
    G2,W2=aligned(f[1]),aligned(f[2]); L2,M2=aligned(f[3]),aligned(f[4]); N2=aligned(f[5].astype(np.int32)); U2=aligned(f[0])
    def nativeF(): return lib.force_10_4(P(U2),ctypes.c_int64(len(N2)),P(G2),P(W2),P(L2),P(M2),P(N2),ctypes.c_int64(len(out1)),ctypes.c_int64(len(en1)),P(out2),P(en2))
    print("det", numbaF(), nativeF(), "force diff", np.abs(out1-out2).max()/np.abs(out1).max(), "energy", abs(en1.sum()-en2.sum())/en1.sum())
    def pair(one,two,n):
        t=[[],[]]
        for _ in range(n):
            for k,fn in enumerate((one,two)):
                s=time.thread_time(); fn(); t[k].append(time.thread_time()-s)
        return [1e3*np.min(x) for x in t]+[1e3*np.median(x) for x in t]
    n=max(5,int(60000/len(mesh.tets)))
    print("tangent ms numba native min/min med/med", np.round(pair(numba,native,n),3)); print("force", np.round(pair(numbaF,nativeF,2*n),3))
